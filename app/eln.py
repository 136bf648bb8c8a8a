"""A campaign as an archive for electronic laboratory notebooks (.eln): run files, settings, marks, notes and report.

A ZIP file of one folder that is an RO-Crate (The ELN Consortium, Specification for the ELN file format; RO-Crate
Metadata Specification 1.1). eLabFTW, Kadi4Mat and RSpace import it.
"""

import json
from collections import Counter
from collections.abc import Mapping
from hashlib import file_digest
from pathlib import Path
from urllib.parse import quote
from zipfile import ZIP_DEFLATED, ZipFile

from dragrig.config import OutputError, RunFileError
from dragrig.rig import Campaign, read_campaign, written_atomically

ELN_SUFFIX = ".eln"
NO_LICENCE = "No licence is stated: ask the authors."
KINDS_OF_FILE = {
    ".h5": ("application/x-hdf5", "run"),
    ".html": ("text/html", "report"),
    ".toml": ("application/toml", "settings of a session, or mark of a bad run"),
    ".txt": ("text/plain", "note on a run"),
}
"""Media type and content."""


def write_eln(folder: Path, target: Path, report: Path, licence: str = "", *, overwrite: bool = False) -> Path:
    """Write a campaign as an archive that electronic laboratory notebooks import.

    Parameters
    ----------
    target
        A file, or a folder in which the archive gets the campaign's name.
    report
        Page on the campaign.
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
    campaign, name = read_campaign(folder), folder.resolve().name
    if not campaign.runs:
        raise RunFileError(f"{folder}: holds no run that can be read; give the folder of a campaign.")
    path = target / f"{name}{ELN_SUFFIX}" if target.is_dir() else target
    if path.exists() and not overwrite:
        raise OutputError(f"{path}: exists already; choose another name, or allow it to be replaced.")
    beside = [*folder.glob("*.toml"), *folder.glob("*.txt")]
    files = {file.name: file for file in (*(run.path for run in campaign.runs), *sorted(beside))}
    files[f"{name}.html"] = report
    try:
        with written_atomically(path) as part, ZipFile(part, "w", ZIP_DEFLATED) as archive:
            for kept, file in files.items():
                archive.write(file, f"{path.stem}/{name}/{kept}")
            described = json.dumps(_metadata(campaign, name, files, licence), indent=1, ensure_ascii=False)
            archive.writestr(f"{path.stem}/ro-crate-metadata.json", described)
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
    runs, parts = {run.path.name: run for run in campaign.runs}, []
    for kept, file in files.items():
        media_type, content = KINDS_OF_FILE[Path(kept).suffix]
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
    terms = {"@type": "CreativeWork", "name": licence or NO_LICENCE, "description": licence or NO_LICENCE}
    crate.license = crate.add(ContextEntity(crate, address, terms))
    return crate.metadata.generate()


def _stated(campaign: Campaign, name: str) -> list[str]:
    return sorted({str(run.header.entry.get(name) or "") for run in campaign.runs} - {""})
