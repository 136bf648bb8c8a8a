"""Which reader a foreign file needs."""

from pathlib import Path

from dragrig.analysis.importing.foreign import ForeignTable
from dragrig.analysis.importing.mapping import ImportSettings
from dragrig.config.errors import ImportDataError

_REFUSED = {
    ".xlsx": "save the sheet as CSV",
    ".xls": "save the sheet as CSV",
    ".ods": "save the sheet as CSV",
    ".h5": "a run file needs no import; export other HDF5 files as CSV or MAT",
    ".hdf5": "export it as CSV or MAT",
    ".nxs": "export it as CSV or MAT",
}


def read_foreign(path: Path, settings: ImportSettings | None = None) -> ForeignTable:
    """Read a measurement by its ending: .mat, .parquet, .tdms, .npz, or text under any other.

    Raises
    ------
    ImportDataError
        When the file cannot be read, or holds no table.
    """
    settings = settings or ImportSettings()
    if not path.is_file():
        raise ImportDataError(f"{path}: there is no such file; give the path of a measurement.")
    ending = path.suffix.lower()
    if ending in _REFUSED:
        raise ImportDataError(f"{path}: {ending} files are not read; {_REFUSED[ending]}.")
    if path.stat().st_size == 0:
        raise ImportDataError(f"{path}: is empty; give a file with a table of numbers.")
    from dragrig.analysis.importing import binary

    if ending == ".mat":
        return binary.read_mat(path, settings.table)
    if ending in {".parquet", ".pq"}:
        return binary.read_parquet(path)
    if ending == ".tdms":
        return binary.read_tdms(path, settings.table)
    if ending == ".npz":
        return binary.read_npz(path)
    from dragrig.analysis.importing.text import read_text

    return read_text(path, settings.encoding, settings.delimiter, settings.decimal, settings.header_lines)
