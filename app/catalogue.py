"""The catalogue of a lab's runs, which answers questions about them.

A catalogue is an SQLite file beside a lab's data root, made from the run files and never the only place of anything.
Before each answer it is compared with the folders, and files that have changed are read again, so that an answer is the
same with and without it. Where it cannot be used, the run files answer.
"""

import json
import os
import sqlite3
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cache
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from dragrig.config import RunFileError, data_root_of
from dragrig.rig import RECORDING_SUFFIX
from dragrig.run_listing import (
    CampaignSummary,
    FileListing,
    RunListing,
    RunQuery,
    ScannedFolder,
    below,
    count_files,
    operator_of,
    scan_folder,
    walk,
)

if TYPE_CHECKING:
    from pydantic import TypeAdapter

    from dragrig.rig import Campaign, RunInfo, RunMark

    _Content = tuple[list[str], list[tuple[str, RunInfo, RunMark | None]], dict[str, str]]

SUFFIX = ".catalogue.sqlite"
"""Of a catalogue's name, after that of the data root."""
FORMAT_VERSION = 3
CHECKED_FILES = 5_000
"""So many run files of the latest campaigns are compared whenever an answer is asked for, which takes 0.05 s; a folder
of older ones only once a name in it has changed."""
BUSY_S = 5.0
"""How long a catalogue that another process writes is waited for."""
SPARE_CONTENT_BYTES, RUN_CONTENT_BYTES = 1 << 20, 1 << 17
"""What is known of a campaign takes no more, for its folder and for each file: a run states some 10 kB."""
GONE_FILES = 100
"""So many files, and half of a campaign, may be removed at once before all that is known of it counts as damaged."""
_APPLICATION_ID = 0x64726167
BATCH_S = 1.0
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_SCHEMA = {
    "folder": "CREATE TABLE folder (id INTEGER PRIMARY KEY, path BLOB NOT NULL UNIQUE, state TEXT NOT NULL, "
    "signature TEXT NOT NULL, files INTEGER NOT NULL, summary TEXT, content BLOB)",
    "run": "CREATE TABLE run (folder INTEGER NOT NULL, place INTEGER NOT NULL, name BLOB NOT NULL, kind BLOB NOT NULL, "
    "sentinel INTEGER NOT NULL, specimen BLOB NOT NULL, specimen_name BLOB NOT NULL, operator BLOB NOT NULL, "
    "start_us INTEGER NOT NULL, bad INTEGER NOT NULL, PRIMARY KEY (folder, place)) WITHOUT ROWID",
}

_INSERT_FOLDER = "INSERT INTO folder (path, state, signature, files, summary, content) VALUES (?, ?, ?, ?, ?, ?)"

Remark = Callable[[str], None]
ReadingProgress = Callable[[int, int], None]
AnswerT = TypeVar("AnswerT")


def ask_runs(
    folder: Path,
    question: Callable[[RunListing], AnswerT],
    *,
    remark: Remark = lambda _: None,
    progress: ReadingProgress = lambda _done, _of: None,
    rebuild: bool = False,
) -> AnswerT:
    """Answer a question about the runs in a folder and below it, from the lab's catalogue or from the run files.

    Parameters
    ----------
    remark
        Takes a sentence where there is a catalogue that cannot be used, or was made again.
    rebuild
        Whether everything in the catalogue is forgotten first.

    Raises
    ------
    RunFileError
        When there is no such folder.
    """
    if not folder.is_dir():
        missing = "is a file" if folder.is_file() else "there is no such folder"
        raise RunFileError(f"{folder}: {missing}; name the folder that holds campaigns.")
    if (root := _catalogued_root(folder)) is not None:
        file = root.with_name(root.name + SUFFIX)
        try:
            return _ask_catalogue(file, root, folder, question, remark, progress, rebuild=rebuild)
        except _UnusableError as error:
            remark(f"{file}: {error}; the run files answer, which takes longer.")
    elif rebuild:
        remark(f"{folder}: is not in the data root of a lab, so there is no catalogue of it.")
    return question(FileListing(folder))


class _UnusableError(Exception):
    """Why a catalogue cannot be used."""


class _DamagedError(Exception):
    """A catalogue holds something else than was written."""


def _catalogued_root(folder: Path) -> Path | None:
    """Return the data root with a catalogue that a folder belongs to: its own lab's, or that of the working folder."""
    here = Path(os.path.realpath(folder))
    for start in (here, Path.cwd()):
        root = data_root_of(start)
        if root is not None and here.is_relative_to(real := Path(os.path.realpath(root))) and real.name:
            return real
    return None


def _ask_catalogue(
    file: Path,
    root: Path,
    folder: Path,
    question: Callable[[RunListing], AnswerT],
    remark: Remark,
    progress: ReadingProgress,
    *,
    rebuild: bool,
) -> AnswerT:
    for attempts_left in (1, 0):
        try:
            with _explained(), closing(_Catalogue(file, root, folder, remark)) as catalogue:
                if rebuild:
                    catalogue.forget()
                catalogue.refresh(progress)
                return question(catalogue)
        except _DamagedError as error:
            try:
                # First the file: SQLite drops the journal of one that is new, and would play it back into an old one.
                for path in (file, file.with_name(f"{file.name}-journal")):
                    path.unlink(missing_ok=True)
            except OSError as refusal:
                raise _UnusableError(f"is damaged and cannot be removed ({refusal.strerror})") from error
            if not attempts_left:
                raise _UnusableError("is damaged") from error
            remark(f"{file}: the catalogue was damaged; it is made again from the run files.")
    raise AssertionError("the last attempt returns or raises")


_NOT_AS_WRITTEN = (
    *(sqlite3.Error, zlib.error, LookupError, TypeError, ValueError, AttributeError, ArithmeticError, RecursionError),
)
"""What reading a catalogue raises that holds something else than was written."""


@contextmanager
def _explained() -> Iterator[None]:
    try:
        yield
    except sqlite3.OperationalError as error:
        raise _UnusableError(f"the catalogue cannot be used ({error})") from error
    except _NOT_AS_WRITTEN as error:
        raise _DamagedError from error


@dataclass(frozen=True, slots=True)
class _KnownFolder:
    """The facts of a folder that the catalogue compares."""

    state: str
    signature: str
    files: int
    is_campaign: bool


@dataclass(frozen=True, slots=True)
class _KnownRun:
    """A run as it was read, while its file and mark had this state."""

    state: str
    info: "RunInfo"
    mark: "RunMark | None"


class _Catalogue:
    """The runs in a folder of the data root and below it, from the catalogue; belongs to one thread.

    Every method may raise the errors that `_explained` explains.
    """

    def __init__(self, file: Path, root: Path, folder: Path, remark: Remark) -> None:
        self._file, self._folder, self._remark = file, folder, remark
        top = Path(os.path.realpath(folder)).relative_to(root).as_posix()
        self._top = "" if top == "." else top
        self._in_memory = False
        self._connection = sqlite3.connect(file, timeout=BUSY_S, isolation_level=None)
        try:
            self._prepare()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Close the file."""
        self._connection.close()

    def folders(self, *, with_files: bool = False) -> tuple[Path, ...]:
        """Return the folders that hold run files or records of sessions, or only those with files of runs."""
        return tuple(folder for folder, files in self._campaign_rows("files") if files or not with_files)

    def summaries(self) -> tuple[CampaignSummary, ...]:
        """Summarise the campaigns."""
        return tuple(_decoded_summary(folder, str(text)) for folder, text in self._campaign_rows("summary"))

    def found(self, query: RunQuery) -> Mapping[Path, tuple[str, ...]]:
        """Return the names of the wanted run files by folder."""
        conditions, values = _conditions(query)
        folders = tuple(self._campaign_rows("id"))
        asked = f"SELECT folder, name FROM run WHERE {conditions} ORDER BY folder, place"  # noqa: S608  # no value in it
        rows = self._connection.execute(asked, values).fetchall()
        # Names are decoded a folder at a time, joined by what no name has: one by one takes longer than finding them.
        names = {
            id_: os.fsdecode(b"\0".join([name for _, name in group])).split("\0")
            for id_, group in groupby(rows, itemgetter(0))
        }
        return {folder: tuple(names[id_]) for folder, id_ in folders if id_ in names}

    def kinds(self) -> tuple[str, ...]:
        """Return the kinds of the runs."""
        ids = {id_ for _, id_ in self._campaign_rows("id")}
        rows = self._connection.execute("SELECT DISTINCT folder, kind, sentinel FROM run").fetchall()
        kinds = {kind.decode("utf-8", "surrogatepass") for id_, kind, _ in rows if id_ in ids}
        return tuple(sorted(kinds | {"sentinel" for id_, _, sentinel in rows if sentinel and id_ in ids}))

    def campaign(self) -> "Campaign":
        """Return the campaign in the folder itself."""
        from dragrig.rig import Campaign, campaign_of

        known, unreadable, names = self._content("")
        if not names:
            return Campaign(self._folder, (), {})

        def read(path: Path) -> "tuple[RunInfo, RunMark | None]":
            if path.name in unreadable:
                raise RunFileError(unreadable[path.name])
            return known[path.name].info, known[path.name].mark

        return campaign_of(self._folder, (self._folder / name for name in names), read)

    def forget(self) -> None:
        """Forget everything."""
        with self._transaction():
            self._connection.execute("DELETE FROM run")
            self._connection.execute("DELETE FROM folder")

    def refresh(self, progress: ReadingProgress) -> None:
        """Bring the entries of the folder and all below it up to date."""
        known = {
            path: _KnownFolder(str(state), str(signature), int(files), bool(is_campaign))
            for path, (state, signature, files, is_campaign) in self._rows(
                "state, signature, files, content IS NOT NULL"
            )
        }
        children: dict[str, list[str]] = {}
        for path in known:
            if path:
                above, _, name = path.rpartition("/")
                children.setdefault(above, []).append(name)
        unchanged: set[str] = set()

        def known_subfolders(path: str, state: str) -> Iterable[str] | None:
            if not state or path not in known or known[path].state != state:
                return None
            unchanged.add(path)
            return children.get(path, ())

        changed = walk(self._folder, known_subfolders)
        seen = unchanged.union(found.path for found in changed)
        changed += self._overwritten({path: known[path] for path in unchanged if known[path].is_campaign})
        gone = {path: folder.signature for path, folder in known.items() if path not in seen}
        if changed or gone:
            self._store(changed, gone, progress)

    def _overwritten(self, campaigns: Mapping[str, _KnownFolder]) -> list[ScannedFolder]:
        """Find the campaigns, of those whose folders changed last, in whose files another program wrote."""
        changed: list[ScannedFolder] = []
        files_left = CHECKED_FILES
        for path, folder in sorted(campaigns.items(), key=lambda item: -int(item[1].state.split(":")[1])):
            files_left -= folder.files
            if files_left < 0:
                break
            with suppress(OSError):
                found, _ = scan_folder(self._folder, path, folder.state)
                if found.signature != folder.signature:
                    changed.append(found)
        return changed

    def _store(self, changed: Iterable[ScannedFolder], gone: Mapping[str, str], progress: ReadingProgress) -> None:
        """Read changed files and write them, a transaction for each second of reading: a killed process loses no more.

        Parameters
        ----------
        gone
            Paths of folders that are no more, with their signatures: a renamed folder is known by its content.
        """
        # A folder after those in it: what is known of it says where else to look.
        work = sorted(changed, key=lambda found: found.path, reverse=True)
        total, done = sum(len(found.files) for found in work), 0
        renamed = {signature: path for path, signature in gone.items() if signature}
        ready: list[tuple[ScannedFolder, Campaign]] = []
        began_s = time.monotonic()
        for found in work:
            progress(done, total)
            ready.append((found, self._read(found, renamed.get(found.signature))))
            done += len(found.files)
            if time.monotonic() - began_s > BATCH_S:
                self._write(ready)
                ready, began_s = [], time.monotonic()
        self._write(ready, gone)
        progress(total, total)

    def _read(self, found: ScannedFolder, path_before: str | None) -> "Campaign":
        """Read the files of a folder that are not known in their present states, by now or by another process."""
        from dragrig.rig import campaign_of, read_marked

        known, _, _ = self._content(found.path)
        if not known and path_before is not None:
            known, _, _ = self._content(path_before, self._folder / found.path)

        def read(path: Path) -> "tuple[RunInfo, RunMark | None]":
            run, state = known.get(path.name), found.files[path.name]
            return (run.info, run.mark) if run is not None and state and run.state == state else read_marked(path)

        folder = self._folder / found.path
        return campaign_of(folder, (folder / name for name in found.files), read)

    def _write(self, ready: "Iterable[tuple[ScannedFolder, Campaign]]", gone: Iterable[str] = ()) -> None:
        with self._transaction():
            ask, ask_many = self._connection.execute, self._connection.executemany
            for path in (*(found.path for found, _ in ready), *gone):
                key = self._key(path)
                ask("DELETE FROM run WHERE folder IN (SELECT id FROM folder WHERE path = ?)", (key,))
                ask("DELETE FROM folder WHERE path = ?", (key,))
            for found, campaign in ready:
                # What could not be read may only have been in use, so it is tried again each time.
                settled = not campaign.unreadable and all(
                    state for name, state in found.files.items() if not name.endswith(RECORDING_SUFFIX)
                )
                row = (
                    self._key(found.path),
                    found.state if settled else "",
                    found.signature if settled and found.files else "",
                    len(found.files),
                    _encoded_summary(CampaignSummary.of(campaign)) if found.is_campaign else None,
                    _encoded_content(campaign, found.files) if found.is_campaign else None,
                )
                id_ = ask(_INSERT_FOLDER, row).lastrowid
                rows = [(id_, place, *_run_columns(run, campaign)) for place, run in enumerate(campaign.runs)]
                ask_many("INSERT INTO run VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", rows)

    def _prepare(self) -> None:
        """Make the tables of a new file, and refuse a file that is not ours."""
        ask = self._connection.execute
        ask("PRAGMA trusted_schema = OFF")
        (application,), (version,) = ask("PRAGMA application_id").fetchone(), ask("PRAGMA user_version").fetchone()
        tables = dict(ask("SELECT name, sql FROM sqlite_master WHERE sql IS NOT NULL"))
        if tables and application != _APPLICATION_ID:
            raise _UnusableError("is a file of another program, not a catalogue of runs")
        if version > FORMAT_VERSION:
            raise _UnusableError("is the catalogue of a newer dragrig")
        if not tables:
            with self._transaction():
                for table in _SCHEMA.values():
                    self._connection.execute(table.replace("CREATE TABLE", "CREATE TABLE IF NOT EXISTS"))
                self._connection.execute(f"PRAGMA application_id = {_APPLICATION_ID}")
                self._connection.execute(f"PRAGMA user_version = {FORMAT_VERSION}")
        elif version != FORMAT_VERSION or tables != _SCHEMA:
            raise _DamagedError

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        # SQLite would begin all the same, and refuse the first change.
        if not (self._in_memory or all(os.access(path, os.W_OK) for path in (self._file, self._file.parent))):
            self._continue_in_memory("no permission")
        try:
            self._connection.execute("BEGIN IMMEDIATE")
        except sqlite3.OperationalError as error:
            self._continue_in_memory(str(error))
            self._connection.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self._connection.execute("ROLLBACK")
            raise
        self._connection.execute("COMMIT")

    def _continue_in_memory(self, why: str) -> None:
        """Go on with a copy of a catalogue that cannot be written."""
        copy = sqlite3.connect(":memory:", isolation_level=None)
        with closing(self._connection):
            self._connection.backup(copy)
        self._connection, self._in_memory = copy, True
        self._remark(f"{self._file}: the catalogue cannot be written ({why}); what is new in it is not kept.")

    def _key(self, path: str) -> bytes:
        return os.fsencode(below(self._top, path) if path else self._top)

    def _rows(self, columns: str) -> Iterator[tuple[str, tuple[Any, ...]]]:
        """Yield these columns of the folders, after their paths relative to the folder that is asked about."""
        top = os.fsencode(self._top)
        above = top + b"/" if top else b""
        asked = f"SELECT path, {columns} FROM folder WHERE path = ? OR substr(path, 1, ?) = ?"  # noqa: S608  # our columns
        for key, *row in self._connection.execute(asked, (top, len(above), above)):
            yield "" if key == top else os.fsdecode(key[len(above) :]), tuple(row)

    def _campaign_rows(self, column: str) -> Iterator[tuple[Path, object]]:
        """Yield this column of the campaigns, after their folders, in the order of `Path`."""
        rows = list(self._rows(f"{column}, content IS NOT NULL"))
        # By the parts of a path: comparing these takes a tenth of what `Path` takes.
        rows.sort(key=lambda row: os.path.normcase(row[0]).split(os.sep))  # noqa: PTH206  # thousands of them
        for path, (value, is_campaign) in rows:
            if is_campaign:
                yield self._folder / path, value

    def _content(
        self, path: str, folder: Path | None = None
    ) -> tuple[Mapping[str, _KnownRun], Mapping[str, str], Sequence[str]]:
        """Return the known runs of a folder, the errors of unreadable ones, and all names."""
        asked = "SELECT content, files FROM folder WHERE path = ? AND content IS NOT NULL"
        row = self._connection.execute(asked, (self._key(path),)).fetchone()
        if row is None:
            return {}, {}, ()
        (content, files), folder = row, folder or self._folder / path
        # The number is the catalogue's own word as the content is, and bounded by what is there.
        return _decoded_content(content, folder, _most_bytes(min(int(files), 2 * count_files(folder) + GONE_FILES)))


def _bytes(text: str) -> bytes:
    return text.encode("utf-8", "surrogatepass")


def _microseconds(moment: datetime) -> int:
    return (moment - _EPOCH) // timedelta(microseconds=1)


def _run_columns(run: "RunInfo", campaign: "Campaign") -> tuple[bytes | int, ...]:
    from dragrig.rig import specimen_key

    folded = (specimen_key(run), str(run.header.specimen["name"]), operator_of(run))
    kind, specimen, specimen_name, operator = map(_bytes, (run.kind, *map(str.casefold, folded)))
    start_us, bad = _microseconds(run.header.start_time), run.path in campaign.marks
    return os.fsencode(run.path.name), kind, run.is_sentinel, specimen, specimen_name, operator, start_us, bad


def _conditions(query: RunQuery) -> tuple[str, list[bytes | int]]:
    """Return the condition of a query and its values, in this order."""
    asked: list[tuple[str, tuple[bytes | int, ...]]] = [("1", ())]
    if query.specimen:
        asked.append(("(specimen = ? OR specimen_name = ?)", (_bytes(query.specimen.casefold()),) * 2))
    if query.kind:
        sentinel = " OR sentinel" if query.kind == "sentinel" else ""
        asked.append((f"(kind = ?{sentinel})", (_bytes(query.kind),)))
    if query.operator:
        asked.append(("instr(operator, ?)", (_bytes(query.operator.casefold()),)))
    if query.since is not None:
        asked.append(("start_us >= ?", (_microseconds(query.since),)))
    if query.until is not None:
        asked.append(("start_us <= ?", (_microseconds(query.until),)))
    if query.marked is not None:
        asked.append(("bad = ?", (query.marked,)))
    return " AND ".join(condition for condition, _ in asked), [value for _, values in asked for value in values]


def _encoded_summary(summary: CampaignSummary) -> str:
    began = None if summary.began is None else summary.began.isoformat()
    return json.dumps(
        [began, summary.specimens, dict(summary.kinds), summary.operators, summary.bad, summary.unreadable]
    )


def _decoded_summary(folder: Path, text: str) -> CampaignSummary:
    began, specimens, kinds, operators, bad, unreadable = json.loads(text)
    started = None if began is None else datetime.fromisoformat(began)
    return CampaignSummary(folder, started, tuple(specimens), kinds, tuple(operators), bad, unreadable)


@cache
def _content_type() -> "TypeAdapter[_Content]":
    """Return how all that is known of a campaign is encoded: names, runs with the states of their files, errors."""
    from pydantic import ConfigDict, TypeAdapter

    from dragrig.rig import RunInfo, RunMark

    content = tuple[list[str], list[tuple[str, RunInfo, RunMark | None]], dict[str, str]]
    return TypeAdapter(content, config=ConfigDict(ser_json_inf_nan="constants"))


def _encoded_content(campaign: "Campaign", states: Mapping[str, str]) -> bytes:
    """Encode everything that is known of a campaign; the settings of a session's runs are alike, so it packs well."""
    runs = [
        (states[run.path.name], replace(run, path=Path(run.path.name)), campaign.marks.get(run.path))
        for run in campaign.runs
    ]
    unreadable = {path.name: str(error) for path, error in campaign.unreadable}
    # Not by pydantic's own JSON, which refuses names that are no text.
    text = json.dumps(_content_type().dump_python((list(states), runs, unreadable), mode="json")).encode("ascii")
    if len(text) > _most_bytes(len(states)):
        raise _UnusableError(f"cannot hold what the runs in {campaign.folder} state of themselves, {len(text)} bytes")
    return zlib.compress(text, 1)


def _most_bytes(files: int) -> int:
    return SPARE_CONTENT_BYTES + files * RUN_CONTENT_BYTES


def _decoded_content(
    packed: bytes, folder: Path, most_bytes: int
) -> tuple[Mapping[str, _KnownRun], Mapping[str, str], Sequence[str]]:
    from dragrig.rig import check_header

    unpacker = zlib.decompressobj()
    text = unpacker.decompress(packed, most_bytes)
    if not unpacker.eof:
        raise _DamagedError
    names, runs, unreadable = _content_type().validate_python(json.loads(text))
    for _, info, _ in runs:
        # As of a file that is read: whoever gets it computes with it.
        check_header(info.header)
    known = {
        info.path.name: _KnownRun(state, replace(info, path=folder / info.path), mark) for state, info, mark in runs
    }
    return known, unreadable, names
