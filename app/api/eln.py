"""A campaign as an archive for electronic laboratory notebooks (.eln): run files, settings, marks, notes and report.

A ZIP file of one folder, an RO-Crate 1.1 (The ELN Consortium, Specification for the ELN file format).
"""

import json
from collections import Counter
from collections.abc import Mapping
from hashlib import file_digest
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote
from zipfile import ZIP_DEFLATED, ZipFile

from dragrig.analysis import Progress, no_progress, printable
from dragrig.api.reports import default_report_file, report
from dragrig.config import OutputError, RunFileError
from dragrig.present import require_writable
from dragrig.rig import Campaign, read_campaign, written_atomically

CONTENTS = {
    ".mark.toml": ("application/toml", "mark of a bad run"),
    ".note.txt": ("text/plain", "note on a run"),
    ".toml": ("application/toml", "plan, specimen, friction model and rig of a session"),
    ".html": ("text/html", "report"),
    ".h5": ("application/x-hdf5", "run"),
}
"""Media type and content of a file, by the first of these that its name ends with."""


def write_eln(
    folder: Path, target: Path, licence: str = "", *, overwrite: bool = False, progress: Progress = no_progress
) -> Path:
    """Write a campaign with its settings, marks, notes and report as an archive that laboratory notebooks import.

    Parameters
    ----------
    target
        A file, or a folder in which the archive gets the campaign's name.
    licence
        Name or web address of the licence of the data.

    Returns
    -------
    The archive.

    Raises
    ------
    RunFileError
        When there is no such campaign, or no run in it can be read.
    OutputError
        When the archive exists already, or cannot be written.
    """
    campaign, name = read_campaign(folder), printable(folder.resolve().name)
    if not campaign.runs:
        raise RunFileError(f"{folder}: holds no run that can be read; give the folder of a campaign.")
    path = target / f"{folder.resolve().name}.eln" if target.is_dir() else target
    require_writable(path, overwrite=overwrite)
    beside = (file for pattern in ("session-*.toml", "*.mark.toml", "*.note.txt") for file in folder.glob(pattern))
    files = {printable(file.name): file for file in (*(run.path for run in campaign.runs), *sorted(beside))}
    try:
        with TemporaryDirectory() as drawn, written_atomically(path) as part:
            page = report(folder, Path(drawn, "report.html"), workers=None, progress=progress)
            files[printable(default_report_file(folder).name)] = page
            root = printable(path.stem)
            with ZipFile(part, "w", ZIP_DEFLATED, strict_timestamps=False) as archive:
                for kept, file in files.items():
                    archive.write(file, f"{root}/{name}/{kept}")
                described = json.dumps(_metadata(campaign, name, files, licence), indent=1, ensure_ascii=False)
                archive.writestr(f"{root}/ro-crate-metadata.json", described)
    except OSError as error:
        raise OutputError(f"{path}: cannot be written ({error.strerror}); choose another folder.") from error
    return path


def _metadata(campaign: Campaign, folder: str, files: Mapping[str, Path], licence: str) -> object:
    """Return as JSON-LD what the archive holds, who made it with which software, and the terms of its use."""
    from rocrate.model import ContextEntity, Dataset, File, Person
    from rocrate.rocrate import ROCrate

    crate = ROCrate(version="1.1")
    people = [crate.add(Person(crate, f"#{quote(name)}", {"name": name})) for name in _stated(campaign, "operator")]
    programs = [
        crate.add(ContextEntity(crate, f"#{quote(name)}", {"@type": "SoftwareApplication", "name": name}))
        for name in _stated(campaign, "software")
    ]
    runs, parts = {printable(run.path.name): run for run in campaign.runs}, []
    for kept, file in files.items():
        media_type, content = next(said for ending, said in CONTENTS.items() if kept.endswith(ending))
        facts = {"name": kept, "description": content, "encodingFormat": media_type}
        if (run := runs.get(kept)) is not None:
            mark = campaign.marks.get(run.path)
            facts["description"] = repr(run).strip("<>") + ("" if mark is None else f"; marked bad: {mark.reason}")
            facts["dateCreated"] = run.header.start_time.isoformat()
        with file.open("rb") as opened:
            facts |= {"contentSize": str(file.stat().st_size), "sha256": file_digest(opened, "sha256").hexdigest()}
        parts.append(crate.add(File(crate, None, f"{folder}/{kept}", properties=facts)))
    kinds = ", ".join(f"{count} {kind}" for kind, count in sorted(Counter(run.kind for run in campaign.runs).items()))
    begun = min(run.header.start_time for run in campaign.runs).isoformat()
    told = {"name": folder, "description": f"Campaign at a drag tester: {kinds}.", "dateCreated": begun}
    whole = crate.add(Dataset(crate, None, f"{folder}/", properties=told))
    root = crate.root_dataset
    for entity, role, values in ((whole, "author", people), (root, "author", people), (whole, "instrument", programs)):
        if values:
            entity[role] = values if len(values) > 1 else values[0]
    whole["hasPart"] = parts
    crate.name, crate.description = told["name"], told["description"]
    address = licence if licence.startswith(("https://", "http://")) else "#licence"
    terms = licence or "No licence is stated: ask the authors."
    facts = {"@type": "CreativeWork", "name": terms, "description": terms}
    crate.license = crate.add(ContextEntity(crate, address, facts))
    return crate.metadata.generate()


def _stated(campaign: Campaign, name: str) -> list[str]:
    return sorted({str(run.header.entry.get(name) or "") for run in campaign.runs} - {""})
