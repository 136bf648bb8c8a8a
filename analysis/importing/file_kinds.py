"""The kind of a foreign file, by its first bytes and never by its name, and the bounds of its reading."""

import bz2
import codecs
import gzip
import lzma
import re
import struct
import zipfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from tempfile import TemporaryDirectory

from dragrig.config import ImportDataError
from dragrig.rig import find_excess, refuse_foreign_storage

MAX_UNPACKED_BYTES = 2 << 30
"""Largest size of a packed file's content: 250 kS/s of a force and a position for nine minutes."""
MAX_UNPACKED_TEXT_BYTES = MAX_UNPACKED_BYTES // 16
"""The same of a spreadsheet, whose cells take some sixteen times their text."""
MAX_MAT_LINKS = 1_000_000
"""MATLAB stores every cell of an array under a name of its own."""
SNIFFED_BYTES = 4096
_BYTE_ORDER_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


class FileKind(StrEnum):
    """A kind of file that is read."""

    TEXT = "text"
    WORKBOOK = "workbook"
    NUMPY = "NumPy"
    PARQUET = "Parquet"
    ARROW = "Feather or Arrow"
    TDMS = "TDMS"
    MAT = "MAT"
    """Versions 4 to 7."""
    MAT73 = "MAT 7.3"
    JSON = "JSON"
    """One value, or a value for each line."""
    GZIP = "gzip"
    BZIP2 = "bzip2"
    XZ = "xz"


_OPENERS: Mapping[FileKind, Callable[[Path], gzip.GzipFile | bz2.BZ2File | lzma.LZMAFile]] = {
    FileKind.GZIP: gzip.GzipFile,
    FileKind.BZIP2: bz2.BZ2File,
    FileKind.XZ: lzma.LZMAFile,
}
PACKED = frozenset(_OPENERS)
"""Kinds whose content is a file again."""

_TABLES = "export its table as CSV, MAT or Parquet"
_UNPACK = "unpack it and import the files in it"
_BINARY = rb"(?=.*\x00)"
_MAGIC: Sequence[tuple[bytes, FileKind | str]] = (
    (rb"\x93NUMPY", FileKind.NUMPY),
    (_BINARY + rb"PAR1", FileKind.PARQUET),
    (_BINARY + rb"ARROW1", FileKind.ARROW),
    (_BINARY + rb"(FEA1|\xff{4}.\x00)", "an Arrow stream or a Feather file of version 1; write it as Parquet"),
    (_BINARY + rb"TDSm", FileKind.TDMS),
    (rb"\x1f\x8b", FileKind.GZIP),
    (rb"BZh[1-9](1AY&SY|\x17rE8P\x90)", FileKind.BZIP2),
    (rb"\xfd7zXZ\x00", FileKind.XZ),
    (rb"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1", FileKind.WORKBOOK),
    (rb"\x80[\x02-\x05]", "a pickle, which can run code when it is opened; write it as Parquet from pandas"),
    (_BINARY + rb"TDSh", "the index of a TDMS file; give the .tdms file beside it"),
    (rb"7z\xbc\xaf|Rar!\x1a|\x28\xb5\x2f\xfd|\x04\x22\x4d\x18|\x1f[\x9d\xa0]", f"a packed archive; {_UNPACK}"),
    (rb".{257}ustar", f"an archive (tar); {_UNPACK}"),
    (rb"%PDF-|\{\\rtf", f"a document, not data; {_TABLES} from the program that made it"),
    (rb"\x89PNG|\xff\xd8\xff|GIF8[79]a|BM.{4}\x00{4}|II\*\x00|MM\x00\*",
     "a picture, not data; export the numbers behind it"),
    (rb"SQLite format 3\x00|\x00\x01\x00\x00Standard ", f"a database; {_TABLES}"),
    (_BINARY + rb"(MDF|UnFinMF) ", "a measurement in MDF; export it as MAT, Parquet or CSV from its program"),
)  # fmt: skip
"""Regular expressions of first bytes, with the kind, or what a file that is not read is and what to do."""
_MARKUP = (
    (r"<usi:tdm|<tdm_root", "the header of a DIAdem TDM file; export the data as TDMS or CSV from DIAdem"),
    (r"urn:schemas-microsoft-com:office:spreadsheet", "an XML spreadsheet; open it in a spreadsheet program and save "
     "it as .xlsx"),
    (r"<html|<!doctype html|<table", "an HTML page, as some instruments save under .xls; open it in a spreadsheet "
     "program and save it as .xlsx"),
    (r"", f"an XML file; {_TABLES} from the program that made it"),
)  # fmt: skip
_JSON_BEGIN = re.compile(
    r"\ufeff?\s*(\{\s*[\"}]|\[\s*([\[{\"\]]|(-?\d[\d.eE+-]*|true|false|null|NaN|-?Infinity)\s*[,\]]))"
)


def file_kind(path: Path) -> FileKind:
    """Tell the kind of a file, by its first bytes and by the names in an archive.

    Raises `ImportDataError` for a file of a kind that is not read, saying which it is, with the remedy.
    """
    with damage_reported(path, "complete"), path.open("rb") as file:
        head = file.read(SNIFFED_BYTES)
        known = next((what for magic, what in _MAGIC if re.match(magic, head, re.DOTALL)), None)
        if isinstance(known, FileKind):
            return known
        if known is not None:
            raise _refusal(path, known)
        if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
            return _zip_kind(path)
        if any(head.startswith(b"\x89HDF\r\n\x1a\n", at) for at in (0, 512, 1024, 2048)):
            return _hdf5_kind(path, head)
        if _is_mat(head):
            return FileKind.MAT
    return _text_kind(path, head)


def _refusal(path: Path, what: str) -> ImportDataError:
    return ImportDataError(f"{path}: is {what}.")


def _zip_kind(path: Path) -> FileKind:
    with zipfile.ZipFile(path) as archive:
        names = archive.namelist()
    if {"content.xml", "mimetype"} <= set(names) or any(name.startswith("xl/work") for name in names):
        return FileKind.WORKBOOK
    if names and all(name.endswith(".npy") for name in names):
        return FileKind.NUMPY
    shown = ", ".join(names[:3]) + (", …" if len(names) > 3 else "")
    raise _refusal(path, f"a zip archive of {shown or 'nothing'}; {_UNPACK}")


def _hdf5_kind(path: Path, head: bytes) -> FileKind:
    import h5py

    with h5py.File(path, "r") as file:
        if (excess := find_excess(file, MAX_MAT_LINKS)) is not None:
            raise ImportDataError(f"{path}: {excess}; export it anew or as CSV.")
        refuse_foreign_storage(file)
        if head.startswith(b"MATLAB 7.3") or any("MATLAB_class" in item.attrs for item in file.values()):
            return FileKind.MAT73
        if any(place in file and file[place].attrs.get("format") == "dragrig-run" for place in ("/", "/entry/run")):
            raise _refusal(path, "a run file, which needs no import; open it as it is")
    raise _refusal(path, "an HDF5 file of another program; export it as CSV or MAT")


def _is_mat(head: bytes) -> bool:
    """Whether these are the header of a MAT file of version 5, or the first variable of one of version 4.

    MathWorks, MAT-File Format: version 5 ends its text header of 128 bytes with the byte order; version 4 begins with
    five integers (type, rows, columns, whether complex, length of the name with its final zero) and the name.
    """
    if head[124:128] in {b"\x00\x01IM", b"\x01\x00MI"}:
        return 0 not in head[:4]
    for order in "<>":
        kind, rows, columns, is_complex, length = struct.unpack(f"{order}5I", head[:20].ljust(20, b"\0"))
        name = re.fullmatch(rb"[A-Za-z]\w*\0", head[20 : 20 + length])
        if kind < 5000 and rows and columns and is_complex < 2 and name:
            return True
    return False


def _text_kind(path: Path, head: bytes) -> FileKind:
    text = head.decode(detect_encoding(head), "replace")
    if re.match(r"\ufeff?\s*<(\?xml|!|html|head>|body|table|meta|style|div)", text, re.IGNORECASE):
        raise _refusal(path, next(what for mark, what in _MARKUP if re.search(mark, text, re.IGNORECASE)))
    if _JSON_BEGIN.match(text):
        return FileKind.JSON
    controls = sum(char < " " and char not in "\t\n\v\f\r\x1a\x1b" for char in text.rstrip("\0"))
    if controls > len(text) // 50:
        raise _refusal(path, "of a binary kind that is not known; export it as text, MAT, Parquet or TDMS")
    return FileKind.TEXT


def detect_encoding(data: bytes) -> str:
    """Return the encoding of a text file: by its byte order mark, else UTF-16 by its zero bytes, UTF-8, or cp1252.

    Tables of numbers hold too few letters for a statistical guess: charset-normalizer takes `[µN]` in cp1252 for Big5
    (docs/decisions/0009).
    """
    for mark, encoding in _BYTE_ORDER_MARKS:
        if data.startswith(mark):
            return encoding
    sample = data[:SNIFFED_BYTES]
    if sample[1::2].count(0) > len(sample) // 4:
        return "utf-16-le"
    if sample[::2].count(0) > len(sample) // 4:
        return "utf-16-be"
    try:
        data.decode("utf-8")
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8"


@contextmanager
def unpacked(path: Path, kind: FileKind) -> Iterator[Path]:
    """Yield the content of a packed file as a file of its own for as long as the context lasts.

    Raises `ImportDataError` when it is damaged, or its content is larger than `MAX_UNPACKED_BYTES`.
    """
    with TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        content = Path(folder) / path.stem
        size = 0
        with damage_reported(path, kind), _OPENERS[kind](path) as packed, content.open("wb") as file:
            while piece := packed.read(1 << 20):
                size += len(piece)
                require_bounded(path, size)
                file.write(piece)
        yield content


@contextmanager
def damage_reported(path: Path, kind: str) -> Iterator[None]:
    """Report a reader's error of a damaged file, of almost any class, as `ImportDataError`."""
    try:
        yield
    except ImportDataError:
        raise
    except Exception as error:
        if isinstance(error, OSError) and error.strerror:
            raise ImportDataError(f"{path}: cannot be read ({error.strerror}); check the path.") from error
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise ImportDataError(
            f"{path}: is damaged or no {kind} file ({reason:.100}); export it anew or as CSV."
        ) from error


def require_bounded(path: Path, unpacked_bytes: int, limit_bytes: int | None = None) -> None:
    """Refuse a packed file before it fills the memory; raises `ImportDataError`."""
    limit_bytes = MAX_UNPACKED_BYTES if limit_bytes is None else limit_bytes
    if unpacked_bytes > limit_bytes:
        raise ImportDataError(
            f"{path}: unpacks to {unpacked_bytes / 1e9:.1f} GB or more, and {limit_bytes / 1e9:.1f} GB is the limit; "
            "export fewer columns or a shorter piece."
        )


def zipped_bytes(path: Path) -> int:
    """Return the size of a zip archive's content as its directory states it, or of a file that is none."""
    if not zipfile.is_zipfile(path):
        return path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        return sum(entry.file_size for entry in archive.infolist())
