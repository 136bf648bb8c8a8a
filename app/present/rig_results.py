"""The check of a plan, the check of a rig and the points of a calibration, laid out for a reader."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from dragrig.analysis import value_with_error
from dragrig.present import (
    Document,
    Field,
    Items,
    Section,
    Table,
    attributes_json,
    decimals,
    duration_text,
    shortest,
    size_text,
)

if TYPE_CHECKING:
    from dragrig.config import Calibration, CommissioningRecord
    from dragrig.rig import CalibrationLine, LoadReading, Preflight, RigCheck, RunPreview, TravelReading

_MAX_PREVIEWS = 200
"""Runs of a plan that a terminal lists; the paper's whole programme has 58."""


def preflight_document(preflight: "Preflight") -> Document:
    """Lay out what a plan would do: each run with its range, speed and time."""
    sentinels = sum(preview.run.sentinel for preview in preflight.previews)
    counted = f", {sentinels} of them sentinels" if sentinels else ""
    return Document(
        title=f"{len(preflight.previews)} runs{counted}, {duration_text(preflight.duration_s)}, "
        f"{size_text(preflight.size_bytes)} of {size_text(preflight.free_bytes)} free",
        sections=(
            Section(
                "runs",
                "",
                (
                    Table.of(
                        "preflight",
                        "",
                        preflight.previews,
                        Field("index", "", lambda preview: str(preview.run.index)),
                        Field("run", "run", lambda preview: preview.run.summary),
                        Field("capsule", "capsule", lambda preview: preview.run.capsule.name),
                        Field("lowest_mm", "min mm", lambda preview: preview.lowest_mm, shortest()),
                        Field("highest_mm", "max mm", lambda preview: preview.highest_mm, shortest()),
                        Field("speed_mm_s", "mm/s", lambda preview: preview.speed_mm_s, shortest()),
                        Field("accel_mm_s2", "mm/s²", lambda preview: preview.accel_mm_s2, shortest()),
                        Field("wait_s", "rest", lambda preview: preview.run.wait_s, duration_text),
                        Field("duration_s", "duration", lambda preview: preview.run.duration_s, duration_text),
                        Field("size_bytes", "size", lambda preview: preview.size_bytes, size_text),
                        Field("prompt", "prompt", lambda preview: preview.run.prompt),
                        brief_rows=_MAX_PREVIEWS,
                    ),
                ),
            ),
        ),
        data={
            "runs": [_preview_json(preview) for preview in preflight.previews],
            **attributes_json(preflight, "duration_s", "size_bytes", "free_bytes", "findings", "remarks"),
        },
    )


def rig_check_document(checks: "Sequence[RigCheck]") -> Document:
    """Lay out the checks of a rig, with those that failed in the answer."""
    failed = [check.name for check in checks if not check.passed]
    return Document(
        title="Check of the rig",
        answer=f"Failed: {', '.join(failed)}." if failed else "The rig is ready: every check passed.",
        sections=(_checks_section("check", checks),),
        data=[attributes_json(check, "detail", name="what", passed="fine") for check in checks],
    )


def commissioning_document(record: "CommissioningRecord") -> Document:
    """Lay out what a guided look at the rig found."""
    failed = [signal.name for signal in record.signals if not signal.passed]
    return Document(
        title="Look at the rig's wiring",
        answer=f"Not as it has to be: {', '.join(failed)}." if failed else "Every signal is as it has to be.",
        sections=(_checks_section("signal", record.signals),),
        data=record.model_dump(),
    )


def _checks_section(item: str, checks: "Sequence[RigCheck]") -> Section:
    table = Table.of(
        f"{item}s",
        "",
        checks,
        Field("passed", "", lambda check: "ok" if check.passed else "FAILED"),
        Field(item, item, lambda check: check.name),
        Field("detail", "result", lambda check: check.detail),
    )
    return Section(f"{item}s", "", (table,))


def sensor_calibration_document(
    entry: "Calibration",
    points: "Sequence[LoadReading | TravelReading]",
    line: "CalibrationLine",
    notes: Sequence[str],
    *,
    stored: bool = True,
) -> Document:
    """Lay out the points of a force or encoder calibration, whether it is in the lab's history already or not."""
    from dragrig.rig import LoadReading, TravelReading

    if entry.quantity == "force":
        gain, zero = value_with_error(line.gain, line.gain_error), value_with_error(line.zero, line.zero_error)
        summary = f"Gain {gain} mN/V, zero {zero} mN, residual {line.residual:.2f} mN (± is one standard error)"
        table = Table.of(
            "points",
            "",
            [point for point in points if isinstance(point, LoadReading)],
            Field("weight_g", "weight, g", lambda point: point.weight_g, shortest()),
            Field("load_mN", "load, mN", lambda point: point.load_mN, decimals(2)),
            Field("reading_V", "reading, V", lambda point: point.reading.force_V, decimals(5)),
            Field("noise_mV", "noise, mV", lambda point: 1e3 * point.reading.force_V_sd, decimals(2)),
            Field(
                "residual_mN",
                "residual, mN",
                lambda point: point.load_mN - line.at(point.reading.force_V),
                decimals(2, signed=True),
            ),
        )
    else:
        count = value_with_error(1e3 * line.gain, 1e3 * line.gain_error)
        summary = f"A count is {count} µm, residual {1e3 * line.residual:.2g} µm (± is one standard error)"
        table = Table.of(
            "points",
            "",
            [point for point in points if isinstance(point, TravelReading)],
            Field("travel_mm", "travel, mm", lambda point: point.travel_mm, shortest()),
            Field("counts", "counts", lambda point: point.counts, decimals(0)),
            Field(
                "residual_um",
                "residual, µm",
                lambda point: 1e3 * (point.travel_mm - line.at(point.counts)),
                decimals(1, signed=True),
            ),
        )
    return Document(
        title=f"{summary}; stored as {entry.id}" if stored else summary,
        sections=(Section("points", "", (table, Items(tuple(notes), remarks=True))),),
        data={"entry": entry.model_dump(), "points": points, "notes": notes},
    )


def _preview_json(preview: "RunPreview") -> dict[str, object]:
    run = preview.run
    return {
        **attributes_json(run, "index", "fixture", "wait_s", "duration_s", "prompt"),
        "kind": run.protocol.kind,
        "parameters": run.protocol.attributes(),
        "capsule": run.capsule.name,
        **attributes_json(preview, "lowest_mm", "highest_mm", "speed_mm_s", "accel_mm_s2", "size_bytes"),
    }
