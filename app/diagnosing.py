"""From a campaign to what its gap is, and to the files that tell it: amended model, report."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from dragrig.analysis.gap.choosing import choose
from dragrig.analysis.gap.results import Diagnosis, Shrink
from dragrig.analysis.identification.selection import Selection
from dragrig.analysis.nominal.catalogue import find_model
from dragrig.analysis.nominal.protocol import NominalModel
from dragrig.analysis.progress import Progress, silent
from dragrig.config.errors import SettingsError
from dragrig.config.library import find
from dragrig.config.loading import nearest, to_toml
from dragrig.config.model import FrictionModelSettings
from dragrig.reports.files import write_text
from dragrig.rig.runfile.model import Run

if TYPE_CHECKING:
    from dragrig.analysis.gap.calibration import Calibration
    from dragrig.analysis.gap.diagnose import Options


@dataclass(frozen=True, slots=True, eq=False)
class DiagnosedCampaign:
    """A diagnosis, and the runs that it was made of."""

    result: Diagnosis
    selection: Selection
    source: str

    @property
    def run_ids(self) -> Mapping[str, str]:
        """Ids of the runs by the names of their files."""
        return {one.file: one.run.info.header.run_id for one in self.selection.experiments}


def diagnose(
    campaign: str | Path | Iterable[Run],
    *,
    nominal: str | Path | NominalModel = "capsule",
    without: Sequence[str] = (),
    tolerance_mN: float | None = None,
    specimen: str | None = None,
    calibration: str | Path | None = None,
    progress: Progress = silent,
) -> Diagnosis:
    """Say where a campaign differs from the nominal model, which effect that is, and how far it closes the gap.

    Parameters
    ----------
    campaign
        A campaign's folder, or runs in memory. It need not be complete: `cannot_answer` says what these runs leave
        open.
    nominal
        What is expected: `capsule` (the friction model), `drive` (the stage alone), a friction model as TOML, a Python
        file with a model of one's own, or a model.
    without
        Effects of the catalogue that are not to be considered.
    tolerance_mN
        Root mean square below which a gap does not matter; the engine's own unless given.
    specimen
        Name or id, where the campaign holds several; the one with the most runs unless given.
    calibration
        What `dragrig gap calibrate --save` wrote; the shipped calibration unless given.

    Raises
    ------
    AnalysisError
        When there is no usable run, or the model says nothing of these runs.
    RunFileError, SettingsError
        When folder or model cannot be read, or an option is none.

    Examples
    --------
    >>> import dragrig
    >>> found = dragrig.diagnose("runs/first")  # doctest: +SKIP
    >>> found.verdict, found.effects, found.ranking[0].probability  # doctest: +SKIP
    >>> dragrig.simulate("drag", model=found.model)  # doctest: +SKIP
    """
    return diagnosed(
        campaign,
        nominal=nominal,
        without=without,
        tolerance_mN=tolerance_mN,
        specimen=specimen,
        calibration=calibration,
        progress=progress,
    ).result


def diagnosed(
    campaign: str | Path | Iterable[Run],
    *,
    nominal: str | Path | NominalModel = "capsule",
    without: Sequence[str] = (),
    tolerance_mN: float | None = None,
    specimen: str | None = None,
    calibration: str | Path | None = None,
    progress: Progress = silent,
) -> DiagnosedCampaign:
    """Do the same, and keep the runs that the diagnosis was made of."""
    from dragrig.analysis.gap.diagnose import diagnose as diagnose_selection

    options = options_of(without, tolerance_mN, calibration)
    model = find_model(str(nominal)) if isinstance(nominal, str | Path) else nominal
    source = str(campaign) if isinstance(campaign, str | Path) else "these runs"
    selection = choose(Path(campaign) if isinstance(campaign, str | Path) else campaign, specimen)
    return DiagnosedCampaign(diagnose_selection(selection, model, options, progress), selection, source)


def gap_evaluate(
    model: str | Path | FrictionModelSettings, campaign: str | Path | Iterable[Run], *, specimen: str | None = None
) -> Shrink:
    """Say how far an amended model closes the gap on fresh runs of the same specimen.

    Parameters
    ----------
    model
        The model that `gap diagnose --save-model` wrote, or `Diagnosis.model`.
    campaign
        Runs that took no part in the diagnosis, best at other speeds.

    Raises
    ------
    AnalysisError
        When there is no usable run.
    RunFileError, SettingsError
        When folder or model cannot be read.
    """
    from dragrig.analysis.gap.evaluate import evaluate

    given = model if isinstance(model, FrictionModelSettings) else find(FrictionModelSettings, "model", str(model))
    return evaluate(choose(Path(campaign) if isinstance(campaign, str | Path) else campaign, specimen), given)


def options_of(without: Sequence[str], tolerance_mN: float | None, calibration: str | Path | None = None) -> "Options":
    """Check what was asked for; raises `SettingsError` for an effect, a tolerance or a calibration that cannot be."""
    from dragrig.analysis.gap.diagnose import Options
    from dragrig.sim_backend.effects.catalogue import catalogue

    known = tuple(catalogue())
    for name in without:
        if name not in known:
            raise SettingsError(f"--without {name}: is not in the catalogue of effects; {nearest(name, known)}")
    tolerance = Options().tolerance_mN if tolerance_mN is None else tolerance_mN
    if not (isfinite(tolerance) and tolerance >= 0):
        raise SettingsError(f"--tolerance {tolerance:g}: a tolerance is a force in mN from 0 on.")
    learnt = None if calibration is None else _calibration(Path(calibration))
    return Options(without=tuple(dict.fromkeys(without)), tolerance_mN=tolerance, calibration=learnt)


def _calibration(path: Path) -> "Calibration":
    from pydantic import ValidationError

    from dragrig.analysis.gap.calibration import Calibration

    try:
        return Calibration.model_validate_json(path.read_text("utf-8"))
    except OSError as error:
        raise SettingsError(f"--calibration {path}: cannot be read ({error.strerror}); name another file.") from error
    except (UnicodeDecodeError, ValidationError) as error:
        raise SettingsError(
            f"--calibration {path}: is not what dragrig gap calibrate --save writes; name such a file."
        ) from error


def save_model(diagnosis: Diagnosis, path: Path, *, overwrite: bool = False) -> Path | None:
    """Write the amended model, which the simulator loads; None where the diagnosis gives none.

    Raises
    ------
    OutputError
        When the file is there already, or the folder refuses.
    """
    if diagnosis.model is None:
        return None
    return write_text(to_toml(diagnosis.model), path, overwrite=overwrite)


def save_report(
    diagnosis: Diagnosis, path: Path, *, source: str = "", model: Path | None = None, overwrite: bool = False
) -> Path:
    """Write the report, one HTML file with its pictures inside; raises as `save_model`."""
    from dragrig.reports.gap.page import page

    return write_text(page(diagnosis, source, None if model is None else str(model)), path, overwrite=overwrite)
