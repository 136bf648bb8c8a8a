"""TDMS files: channels put onto common rows by the clocks of their waveforms."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dragrig.analysis.importing.clocks import moment_of, moments_column
from dragrig.analysis.importing.containers import Found, array_column
from dragrig.analysis.importing.file_kinds import damage_reported, require_bounded
from dragrig.analysis.importing.foreign import ForeignColumn, ForeignTable
from dragrig.analysis.importing.units import CONVERTIBLE_UNITS, canonical_unit

if TYPE_CHECKING:
    from nptdms import TdmsChannel

ROW_TOLERANCE = 0.1
"""Largest distance of samples that count as one row [sample periods], as `ImportSettings.tolerance` has it."""
MIN_COMMON_SHARE = 0.5
"""Of its samples that each channel of a table keeps."""
_UNSET = np.datetime64("1904-01-02")
"""LabVIEW's clock begins on the first of January 1904, which stands for a start that nobody set."""


@dataclass(frozen=True, slots=True, eq=False)
class _Channel:
    number: int
    """In the file."""
    group: str
    column: ForeignColumn
    increment_s: float = 0.0
    """0 for a channel without a clock."""
    begin_ns: int = 0
    """Of the first sample: since 1970, or since an unknown start."""
    is_dated: bool = False
    cut: int = 0
    """Samples that other channels of the table do not share."""

    @property
    def rows(self) -> int:
        return len(self.column.values)


_Table = tuple[_Channel, ...]


def read_tdms(path: Path) -> tuple[ForeignTable, ...]:
    """Read a TDMS file; raises `ImportDataError` when it is none, or holds no table.

    Channels whose waveforms have one increment and begin a whole number of increments apart are one table, cut to the
    stretch that they share; those of several groups too, if the groups are dated and no name occurs twice. Channels
    without a clock are a table with those of their group that have as many values.
    """
    from nptdms import TdmsFile
    from nptdms.log import log_manager

    log_manager.set_level(logging.ERROR)  # it warns on the terminal of what the remarks say
    with damage_reported(path, "TDMS"):
        groups = TdmsFile.read_metadata(path).groups()
        require_bounded(path, 8 * sum(len(channel) for group in groups for channel in group.channels()))
        file = TdmsFile.read(path)
        contents = [channel for group in file.groups() for channel in group.channels()]
        channels = [_channel(number, channel) for number, channel in enumerate(contents)]
        tables = _across_groups(_within_groups([channel for channel in channels if channel.rows]))
        found = Found(list(_named(path, tables)), list(_remarks(tables)))
        found.remarks += [f"channel {channel.column.name!r} is empty" for channel in channels if not channel.rows]
        if file.file_status.incomplete_final_segment:
            found.remarks.append("the file ends in the middle of a block: its recording or its copy was cut off")
        return found.finished(path)


def _channel(number: int, channel: "TdmsChannel") -> _Channel:
    properties = channel.properties
    values = np.asarray(channel[:])
    if values.dtype.kind == "M":
        return _Channel(number, channel.group_name, moments_column(channel.name, values, UTC))
    units = str(properties.get("unit_string") or properties.get("NI_UnitDescription") or "")
    column = array_column(channel.name, values, units)
    x_unit = canonical_unit(str(properties.get("wf_xunit_string") or "s")) or ""
    x_unit_s = CONVERTIBLE_UNITS["s"].get(x_unit, 0.0)
    increment_s = float(properties.get("wf_increment", 0.0)) * x_unit_s
    if not increment_s > 0:
        return _Channel(number, channel.group_name, column)
    start = properties.get("wf_start_time", _UNSET)
    begin_ns = round(float(properties.get("wf_start_offset", 0.0)) * x_unit_s * 1e9)
    if is_dated := bool(start > _UNSET):
        begin_ns += int(start.astype("datetime64[ns]").astype(np.int64))
    return _Channel(number, channel.group_name, column, increment_s, begin_ns, is_dated)


def _aligned(channels: Sequence[_Channel]) -> _Table | None:
    """Put channels onto common rows, or return None when their clocks or lengths do not allow it."""
    if len({channel.column.name for channel in channels}) < len(channels):
        return None
    clocked = [channel for channel in channels if channel.increment_s]
    if len(clocked) < len(channels) and len({channel.rows for channel in channels}) > 1:
        return None
    step_s = clocked[0].increment_s if clocked else 1.0
    first_ns = max((channel.begin_ns for channel in clocked), default=0)
    early = np.array([(first_ns - c.begin_ns) * 1e-9 / step_s if c.increment_s else 0.0 for c in channels])
    late_by = np.rint(early).astype(int)
    drifts = [abs(channel.increment_s / step_s - 1) * channel.rows for channel in clocked]
    if max([*np.abs(early - late_by), *drifts]) > ROW_TOLERANCE or len({channel.is_dated for channel in clocked}) > 1:
        return None
    rows = min(channel.rows - skipped for channel, skipped in zip(channels, late_by.tolist(), strict=True))
    if (len(clocked) < len(channels) and late_by.any()) or any(
        rows < MIN_COMMON_SHARE * (channel.rows + channel.cut) for channel in channels
    ):
        return None
    return tuple(_part(channel, skipped, rows) for channel, skipped in zip(channels, late_by.tolist(), strict=True))


def _part(channel: _Channel, first: int, rows: int) -> _Channel:
    return replace(
        channel,
        column=replace(channel.column, values=channel.column.values[first : first + rows]),
        begin_ns=channel.begin_ns + round(first * channel.increment_s * 1e9),
        cut=channel.cut + channel.rows - rows,
    )


def _within_groups(channels: Sequence[_Channel]) -> list[_Table]:
    """Join the channels of each group, those with clocks first, which decide on the rows."""
    tables: list[_Table] = []
    for channel in sorted(channels, key=lambda channel: not channel.increment_s):
        for number, table in enumerate(tables):
            if table[0].group == channel.group and (joined := _aligned((*table, channel))):
                tables[number] = joined
                break
        else:
            tables.append((channel,))
    return tables


def _across_groups(tables: Sequence[_Table]) -> list[_Table]:
    """Join tables of several groups that were measured at the same time, if there is only one way to do so."""
    friends = [
        [number for number, other in enumerate(tables) if other is table or _are_simultaneous(table, other)]
        for table in tables
    ]
    joined: list[_Table] = []
    for number, (table, others) in enumerate(zip(tables, friends, strict=True)):
        is_closed = all(friends[other] == others for other in others)
        together = _aligned([channel for other in others for channel in tables[other]]) if is_closed else None
        if together is None or others[0] == number:
            joined.append(together or table)
    return joined


def _are_simultaneous(table: _Table, other: _Table) -> bool:
    are_dated = table[0].is_dated and other[0].is_dated and table[0].group != other[0].group
    return are_dated and _aligned((*table, *other)) is not None


def _named(path: Path, tables: Sequence[_Table]) -> Iterator[ForeignTable]:
    """Name tables by their groups; of several in a group, all but the longest also by their first channel."""
    for table in tables:
        lead = table[0]
        name = " + ".join(dict.fromkeys(channel.group for channel in table))
        longest = max((other for other in tables if other[0].group == lead.group), key=lambda other: other[0].rows)
        yield ForeignTable(
            path,
            tuple(channel.column for channel in sorted(table, key=lambda channel: channel.number)),
            name=name if longest is table else f"{name}.{lead.column.name}",
            sample_rate_hz=1 / lead.increment_s if lead.increment_s else None,
            begins_at=moment_of(np.datetime64(lead.begin_ns, "ns"), UTC) if lead.is_dated else None,
        )


def _remarks(tables: Sequence[_Table]) -> Iterator[str]:
    """Say which samples were cut, and which channels of a group could not be put onto common rows."""
    for table in tables:
        if cut := [f"{channel.cut} of {channel.column.name!r}" for channel in table if channel.cut]:
            yield f"channels begin or end apart: {table[0].rows} common rows were taken, without {', '.join(cut)}"
    for group in dict.fromkeys(table[0].group for table in tables):
        apart = [", ".join(channel.column.name for channel in table) for table in tables if table[0].group == group]
        if len(apart) > 1:
            yield f"channels of group {group!r} have not one clock and length, so are tables: {'; '.join(apart)}"
