"""What a rig would do and how it was calibrated, laid out for a reader: the check of a plan, calibration points."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from dragrig.present.document import Column, Document, Items, Section, Table
from dragrig.present.json_values import to_json_object
from dragrig.present.numbers import decimals, duration_text, shortest, size_text

if TYPE_CHECKING:
    from dragrig.config.rig import Calibration
    from dragrig.rig.preflight import Preflight, RunPreview
    from dragrig.rig.sensor_calibration import CalibrationLine, LoadReading, TravelReading


def preflight_document(preflight: "Preflight") -> Document:
    """Lay out what a plan would do: each run with its range, speed and time."""
    columns = (
        Column("index", ""),
        Column("run", "run"),
        Column("capsule", "capsule"),
        Column("lowest_mm", "min mm", shortest()),
        Column("highest_mm", "max mm", shortest()),
        Column("speed_mm_s", "mm/s", shortest()),
        Column("accel_mm_s2", "mm/s²", shortest()),
        Column("wait_s", "rest", duration_text),
        Column("duration_s", "duration", duration_text),
        Column("size_bytes", "size", size_text),
        Column("prompt", "prompt"),
    )
    rows = tuple(
        (
            str(preview.run.index),
            preview.run.protocol.summary(),
            preview.run.capsule.name,
            preview.lowest_mm,
            preview.highest_mm,
            preview.speed_mm_s,
            preview.accel_mm_s2,
            preview.run.wait_s,
            preview.run.duration_s,
            preview.size_bytes,
            preview.run.prompt,
        )
        for preview in preflight.previews
    )
    return Document(
        title=f"{len(rows)} runs, {duration_text(preflight.duration_s)}, {size_text(preflight.size_bytes)} "
        f"of {size_text(preflight.free_bytes)} free",
        sections=(Section("runs", "", (Table("preflight", "", columns, rows),)),),
        data=to_json_object(
            {
                "runs": [_preview_json(preview) for preview in preflight.previews],
                "duration_s": preflight.duration_s,
                "size_bytes": preflight.size_bytes,
                "free_bytes": preflight.free_bytes,
                "findings": preflight.findings,
            }
        ),
    )


def force_calibration_document(
    entry: "Calibration", points: "Sequence[LoadReading]", line: "CalibrationLine", notes: Sequence[str]
) -> Document:
    """Lay out the points of a force calibration."""
    columns = (
        Column("weight_g", "weight, g", shortest()),
        Column("load_mN", "load, mN", decimals(2)),
        Column("reading_V", "reading, V", decimals(5)),
        Column("noise_mV", "noise, mV", decimals(2)),
        Column("residual_mN", "residual, mN", decimals(2, signed=True)),
    )
    rows = tuple(
        (
            point.weight_g,
            point.load_mN,
            point.reading.force_V,
            1e3 * point.reading.force_V_sd,
            point.load_mN - line.at(point.reading.force_V),
        )
        for point in points
    )
    summary = (
        f"Gain {line.gain:.6g} ± {line.gain_error:.2g} mN/V, zero {line.zero:.2f} ± {line.zero_error:.2f} mN, residual "
        f"{line.residual:.2f} mN"
    )
    return _calibration_document(summary, entry, points, Table("points", "", columns, rows), notes)


def encoder_calibration_document(
    entry: "Calibration", points: "Sequence[TravelReading]", line: "CalibrationLine", notes: Sequence[str]
) -> Document:
    """Lay out the points of an encoder calibration."""
    columns = (
        Column("travel_mm", "travel, mm", shortest()),
        Column("counts", "counts", decimals(0)),
        Column("residual_um", "residual, µm", decimals(1, signed=True)),
    )
    rows = tuple((point.travel_mm, point.counts, 1e3 * (point.travel_mm - line.at(point.counts))) for point in points)
    summary = (
        f"A count is {1e3 * line.gain:.6g} ± {1e3 * line.gain_error:.2g} µm, residual {1e3 * line.residual:.2g} µm"
    )
    return _calibration_document(summary, entry, points, Table("points", "", columns, rows), notes)


def _calibration_document(
    summary: str, entry: "Calibration", points: Sequence[object], table: Table, notes: Sequence[str]
) -> Document:
    return Document(
        title=f"{summary}; stored as {entry.id}",
        sections=(Section("points", "", (table, Items(tuple(notes), remarks=True))),),
        data=to_json_object({"entry": entry.model_dump(), "points": points, "notes": notes}),
    )


def _preview_json(preview: "RunPreview") -> dict[str, object]:
    run = preview.run
    return {
        "index": run.index,
        "kind": run.protocol.kind,
        "parameters": run.protocol.attributes(),
        "capsule": run.capsule.name,
        "fixture": run.fixture,
        "lowest_mm": preview.lowest_mm,
        "highest_mm": preview.highest_mm,
        "speed_mm_s": preview.speed_mm_s,
        "accel_mm_s2": preview.accel_mm_s2,
        "wait_s": run.wait_s,
        "duration_s": run.duration_s,
        "size_bytes": preview.size_bytes,
        "prompt": run.prompt,
    }
