"""Foreign measurements into run files."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from dragrig.analysis.importing import ColumnMap, Imported, ImportSettings, import_file, parse_map
from dragrig.config.loading import Table, merge, parse, read_toml
from dragrig.rig.runfile import campaign


def import_settings(
    assignments: Sequence[str], given: Mapping[str, object], file: str | Path | None = None
) -> ImportSettings:
    """Put together how a measurement is read.

    Parameters
    ----------
    assignments
        Which column is which quantity, each `QUANTITY=COLUMN:UNIT`, as `force=Load:N`.
    given
        Further keys of `ImportSettings`, as `decimal` or `sample_rate_hz`.
    file
        TOML file with the same keys; what is given besides wins.

    Raises
    ------
    SettingsError, ImportDataError
        For a key, a value or an assignment that is not allowed.
    """
    base: Table = read_toml(Path(file)) if file is not None else {}
    columns: ColumnMap = parse_map(assignments)
    changes: Table = {**given, "columns": columns.model_dump(exclude_none=True, exclude_unset=True)}
    return parse(ImportSettings, merge(base, changes), str(file) if file is not None else "import")


def next_order(folder: Path) -> int:
    """Return the order that the next run of a folder gets: after all that are there."""
    return max((one.header.order + 1 for one in campaign(folder).runs), default=0)


def import_run(
    path: str | Path,
    to: str | Path,
    columns: Mapping[str, str] | None = None,
    *,
    settings: str | Path | None = None,
    **given: object,
) -> Imported:
    """Turn a foreign measurement (CSV and other text, MAT, Parquet, TDMS, NPZ) into a run file.

    Parameters
    ----------
    to
        A run file to be, or a folder in which it gets its usual name.
    columns
        Which column is which quantity: `{"time": "t:s", "force": "Load:N"}`. Needed unless the file is an
        export of this software.
    settings
        TOML file with the same keys, for measurements that come again and again.
    given
        Further settings: `decimal`, `delimiter`, `encoding`, `sample_rate_hz`, `resample_hz`, `kind`, …. In a
        folder, `order` follows those of the runs that are there.

    Raises
    ------
    ImportDataError
        When the file does not hold what the settings say.
    OutputError
        When something stands at the target already, or it cannot be written.
    SettingsError
        For a setting that is not allowed.

    Examples
    --------
    >>> import dragrig
    >>> dragrig.import_run("old.csv", "runs", {"time": "1:s", "force": "Load:N"}, decimal=",")  # doctest: +SKIP
    """
    target = Path(to)
    if target.is_dir():
        given.setdefault("order", next_order(target))
    assignments = [f"{quantity}={source}" for quantity, source in (columns or {}).items()]
    return import_file(Path(path), target, import_settings(assignments, given, settings))
