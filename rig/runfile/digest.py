"""`raw_sha256`: the checksum that tells whether a trace still is what was recorded."""

import hashlib

import h5py
import numpy as np

from dragrig.rig.arrays import AnyFloatArray, PhaseArray

PIECE = 1 << 19
"""Samples read at a time, so that memory does not grow with the run."""


class TraceDigest:
    """SHA-256 over the datasets of `/entry/trace`, in the order of their names.

    Each dataset adds one line of UTF-8, `NAME TYPE COUNT` and a line feed, where TYPE is NumPy's code of
    the little-endian type (`<f8`, `<f4`, `|u1`), and then its samples as little-endian bytes. How the file
    is chunked, compressed or annotated does not matter.
    """

    def __init__(self) -> None:
        self._hash = hashlib.sha256()

    def begin(self, name: str, dtype: np.dtype[np.generic], samples: int) -> None:
        """Begin the next dataset; names must come in rising order."""
        self._hash.update(f"{name} {little(dtype).str} {samples}\n".encode())

    def update(self, values: AnyFloatArray | PhaseArray) -> None:
        """Add the next samples of the dataset begun."""
        self._hash.update(np.ascontiguousarray(values, dtype=little(values.dtype)).view(np.uint8).data)

    def hexdigest(self) -> str:
        """Return the checksum of all that was added."""
        return self._hash.hexdigest()


def little(dtype: np.dtype[np.generic]) -> np.dtype[np.generic]:
    """Return a type in little-endian order."""
    return dtype.newbyteorder("<")


def trace_sha256(trace: h5py.Group) -> str:
    """Compute the checksum of a trace in a file, piece by piece."""
    digest = TraceDigest()
    for name in sorted(trace):
        dataset = trace[name]
        samples = int(dataset.shape[0])
        digest.begin(name, dataset.dtype, samples)
        for start in range(0, samples, PIECE):
            digest.update(dataset[start : start + PIECE])
    return digest.hexdigest()
