"""Runs out of their run files, for other programs."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from dragrig.analysis.exporting.content import Content, content_of
from dragrig.analysis.exporting.text import CsvStyle
from dragrig.analysis.progress import Progress, silent
from dragrig.config.errors import OutputError, RunFileError
from dragrig.rig.runfile.model import Run


class ExportFormat(StrEnum):
    """What can be exported to; the value is the file's ending as well."""

    CSV = "csv"
    PARQUET = "parquet"
    MAT = "mat"
    NPZ = "npz"


@dataclass(frozen=True, slots=True)
class CampaignExport:
    """Files written, and runs left out with the reason."""

    written: tuple[Path, ...]
    left_out: tuple[tuple[Path, str], ...]


def export_run(
    path: Path,
    target: Path,
    export_format: ExportFormat = ExportFormat.CSV,
    style: CsvStyle | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Path:
    """Export a run file.

    Parameters
    ----------
    target
        A file, or a folder in which the export gets the run's name.
    style
        Decimal mark and delimiter of a CSV file.
    overwrite
        Whether an export that stands there already may be replaced.

    Returns
    -------
    Path
        The file written; it appears at once, when it is whole.

    Raises
    ------
    RunFileError
        When the run cannot be read.
    OutputError
        When the file exists already, or the folder refuses.
    """
    from dragrig.rig.runfile import read_run

    target = _file_of(path, target, export_format)
    _check_free(target, overwrite=overwrite)
    return write_export(read_run(path), target, export_format, style, overwrite=overwrite, progress=progress)


def export_campaign(
    folder: Path,
    target: Path,
    export_format: ExportFormat = ExportFormat.CSV,
    style: CsvStyle | None = None,
    *,
    overwrite: bool = False,
    with_bad: bool = False,
    progress: Progress = silent,
) -> CampaignExport:
    """Export every run of a campaign into a folder, one file each.

    Runs marked as bad are left out unless `with_bad`; files that cannot be read are left out and said.

    Raises
    ------
    RunFileError
        When there is no such campaign.
    OutputError
        When one of the files exists already (then none is written), or the folder refuses.
    """
    from dragrig.rig.runfile import campaign

    found = campaign(folder)
    bad = {} if with_bad else {path: f"marked as bad: {mark.reason}" for path, mark in found.marks.items()}
    wanted = [info.path for info in found.runs if info.path not in bad]
    try:
        target.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{target}: cannot be made a folder ({error.strerror}); choose another.") from error
    for path in wanted:
        _check_free(_file_of(path, target, export_format), overwrite=overwrite)
    written: list[Path] = []
    left_out = [*bad.items(), *((path, str(error)) for path, error in found.unreadable)]
    for done, path in enumerate(wanted):
        progress(done, len(wanted))
        try:
            written.append(export_run(path, target, export_format, style, overwrite=overwrite))
        except RunFileError as error:
            left_out.append((path, str(error)))
    progress(len(wanted), len(wanted))
    return CampaignExport(tuple(written), tuple(left_out))


def write_export(
    run: Run,
    target: Path,
    export_format: ExportFormat,
    style: CsvStyle | None = None,
    *,
    overwrite: bool = False,
    progress: Progress = silent,
) -> Path:
    """Export a run that was read already; otherwise as `export_run`."""
    _check_free(target, overwrite=overwrite)
    if target.exists() and target.samefile(run.info.path):
        raise OutputError(f"{target}: is the run file itself; give the export another name.")
    with _made_whole(target) as part:
        _write(part, content_of(run), export_format, style or CsvStyle(), progress)
    return target


def _write(part: Path, content: Content, export_format: ExportFormat, style: CsvStyle, progress: Progress) -> None:
    from dragrig.analysis.exporting import binary, text

    match export_format:
        case ExportFormat.CSV:
            text.write(part, content, style, progress)
        case ExportFormat.PARQUET:
            binary.write_parquet(part, content, progress)
        case ExportFormat.MAT:
            binary.write_mat(part, content)
        case ExportFormat.NPZ:
            binary.write_npz(part, content)


def _file_of(path: Path, target: Path, export_format: ExportFormat) -> Path:
    return target / f"{path.stem}.{export_format}" if target.is_dir() else target


def _check_free(target: Path, *, overwrite: bool) -> None:
    if target.is_dir():
        raise OutputError(f"{target}: is a folder; give the name of a file.")
    if target.exists() and not overwrite:
        raise OutputError(f"{target}: exists already; choose another name, or allow it to be written over.")


@contextmanager
def _made_whole(target: Path) -> Iterator[Path]:
    """Give a file to write beside the target, and put it in the target's place once it is whole."""
    from dragrig.rig.runfile.files import drop, put_in_place

    part = target.with_name(f"{target.name}.part")
    try:
        yield part
        put_in_place(part, target)
    except OSError as error:
        raise OutputError(
            f"{target}: could not be written ({error.strerror or error}); choose another folder, or make room."
        ) from error
    finally:
        drop(part)
