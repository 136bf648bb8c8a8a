"""The pages that look at runs and diagnose them, used as a person uses them, on real files."""

import re
import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from property_tests import thorough
from windows import Until, dressed, press, require_qt

require_qt()

from PySide6.QtCore import QPoint, QRect, QSettings, Qt
from PySide6.QtGui import QPalette
from PySide6.QtWidgets import QApplication, QFileDialog, QLabel, QMenu, QTableWidget, QTreeWidgetItem
from pytestqt.qtbot import QtBot

import dragrig
from diagnoses import STRIBECK, without_pictures
from dragrig.present.diagnosis import diagnosis_document
from dragrig.rig import mark_bad
from dragrig.rig.runfile.filesystem import lock_run
from dragrig.views import FORMATS, CompletedDiagnosis, ShownTrace, shown_trace
from dragrig.window import prepared_traces, widgets
from dragrig.window.diagnose_page import DiagnosePage
from dragrig.window.look_page import UNREADABLE, LookPage
from dragrig.window.widgets import DrawnFigure, StoredSettings, fill_table, save_picture, table, top_items
from places import copied_runs
from runfiles import record

pytestmark = pytest.mark.usefixtures("finished_here")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two drags and their ways back."""
    root = tmp_path_factory.mktemp("runs")
    short = ["travel_mm=10", "rest_s=0.5", "hold_s=0.5", "wait_s=0", "speed_mm_s=[5,20]"]
    dragrig.simulate("drag", out=root / "first", assignments=short)
    return root


@pytest.fixture
def remembered(tmp_path: Path) -> StoredSettings:
    return StoredSettings(QSettings(str(tmp_path / "window.ini"), QSettings.Format.IniFormat))


@pytest.fixture(scope="module")
def shared(qapp: QApplication, folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LookPage]:
    """One page for many tests: to lay it out takes longer than what most of them look at."""
    dressed()
    settings = QSettings(str(tmp_path_factory.mktemp("settings") / "window.ini"), QSettings.Format.IniFormat)
    made = LookPage(folder, StoredSettings(settings))
    made.show()
    yield made
    made.keep()
    made.close()


@pytest.fixture
def page(shared: LookPage, folder: Path, until: Until) -> LookPage:
    """A page on the two drags that shows nothing yet, as it is at first."""
    shared.browser.words_to_find.clear()
    shared.browser.tree.clearSelection()
    until(lambda: not shared.overlay.traces and not shared.steady.rows)
    if shared.browser.folder.text() != str(folder):
        shared.browser.open_folder(str(folder))
    overlay = shared.overlay
    overlay.window_ms.put(50.0)
    overlay.order.put(3)
    overlay.axis.setCurrentText("time")
    overlay.raw.setChecked(True)
    overlay.cursors.setChecked(False)
    listed = [str(folder / "first")]
    until(lambda: [item.toolTip(0) for item in top_items(shared.browser.tree)] == listed and len(runs_of(shared)) == 4)
    return shared


def runs_of(page: LookPage) -> list[QTreeWidgetItem]:
    tops = top_items(page.browser.tree)
    return [child for item in tops for at in range(item.childCount()) if (child := item.child(at)) is not None]


def choose(page: LookPage, until: Until, *places: int) -> None:
    page.browser.tree.clearSelection()
    for place in places:
        runs_of(page)[place].setSelected(True)
    until(lambda: len(page.overlay.traces) == len(places) and len(page.steady.rows) == len(places))


def test_a_long_run_is_prepared_beside_the_gui_thread_and_then_drawn(
    page: LookPage, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    overlay, prepared = page.overlay, page.overlay.prepared
    choose(page, until, 0, 2)
    shown = overlay.channel_plot.shown()
    monkeypatch.setattr(prepared_traces, "MAX_SAMPLES_AT_ONCE", 100)
    threads: set[str] = set()
    made = prepared_traces.DrawingKey.drawing

    def noting(key: prepared_traces.DrawingKey, trace: ShownTrace) -> object:
        threads.add(threading.current_thread().name)
        return made(key, trace)

    monkeypatch.setattr(prepared_traces.DrawingKey, "drawing", noting)
    overlay.axis.setCurrentText("position")
    assert overlay.channel_plot.lines == []
    overlay.cursors.click()
    until(lambda: not prepared.busy)
    assert len(overlay.channel_plot.lines) == 4
    assert overlay.channel_plot.shown()[0] > 35.0, "the way is not fitted"
    values = [overlay.values.item(at, 1).text() for at in range(1, overlay.values.rowCount())]
    assert "no sample" not in values
    overlay.axis.setCurrentText("time")
    until(lambda: not prepared.busy)
    assert overlay.channel_plot.shown() == pytest.approx(shown, abs=0.05)
    overlay.cursors.click()
    assert threading.main_thread().name not in threads


def test_runs_are_overlaid_with_their_settings(page: LookPage, until: Until) -> None:
    choose(page, until, 0, 2)
    first, second = page.overlay.traces
    assert first.label.endswith("drag 5 mm/s")
    assert second.label.endswith("drag 20 mm/s")
    table = page.browser.settings
    text = {table.item(at, 0).text(): table.item(at, 1).text() for at in range(table.rowCount())}
    assert text["travel"] == "10 mm"
    assert text["status"] == "complete"


def test_positions_are_absolute_with_the_limits(page: LookPage, until: Until) -> None:
    choose(page, until, 0)
    overlay = page.overlay
    assert overlay.channel_plot.levels == ()
    overlay.channel.setCurrentText("position")
    assert overlay.traces[0].channels["position"][0] == pytest.approx(40.0, abs=0.1)
    assert overlay.channel_plot.levels == (0.0, 150.0)
    overlay.channel.setCurrentText("force")
    overlay.axis.setCurrentText("position")
    assert overlay.channel_plot.levels == ()
    assert overlay.channel_plot.shown()[0] > 35.0
    overlay.axis.setCurrentText("time")


def test_changing_the_filter_redraws_the_traces(page: LookPage, until: Until) -> None:
    choose(page, until, 0)
    before, run = page.overlay.traces[0].filtered["force"], page.overlay.traces[0].run
    page.overlay.window_ms.put(200.0)
    until(lambda: page.overlay.traces[0].filtered["force"] is not before)
    after = page.overlay.traces[0].filtered["force"]
    assert np.std(np.diff(after)) < np.std(np.diff(before))
    expected = dragrig.filter(dragrig.load(page.overlay.traces[0].path), window_s=0.2).filtered
    assert expected is not None
    np.testing.assert_allclose(after, expected.channels["force"], rtol=1e-5)
    page.overlay.order.put(1)
    until(lambda: page.overlay.traces[0].filtered["force"] is not after)
    assert page.overlay.traces[0].run is run, "the file was read once more"
    page.overlay.channel.setCurrentText("motor_force")
    until(lambda: "motor_force" in page.overlay.traces[0].filtered)
    page.overlay.channel.setCurrentText("force")
    until(lambda: "force" in page.overlay.traces[0].filtered)


def test_an_impossible_filter_is_reported(page: LookPage, until: Until) -> None:
    choose(page, until, 0)
    text: list[str] = []
    page.complained.connect(text.append)
    page.overlay.order.put(8)
    page.overlay.window_ms.put(1.0)
    until(lambda: bool(text))
    assert "too short" in text[0]


def test_cursors_show_values_and_their_difference(page: LookPage, until: Until) -> None:
    choose(page, until, 0)
    page.overlay.cursors.click()
    first, second = page.overlay.cursor_lines
    first.place(1.0)
    second.place(1.5)
    values = page.overlay.values
    assert [values.item(0, at).text() for at in range(1, 4)] == ["1.0000", "1.5000", "0.5000"]
    trace = page.overlay.traces[0]
    shown = float(values.item(1, 1).text())
    assert shown == pytest.approx(trace.filtered["force"][round(trace.rate_hz)], abs=1e-3)
    choose(page, until, 0, 1, 2, 3)
    page.resize(1010, 540)  # what a window of 1024 by 650 leaves
    until(lambda: values.rowCount() == 5 and values.visibleRegion().boundingRect() == values.rect())
    assert values.viewport().height() >= values.verticalHeader().length()
    assert page.rect().contains(QRect(values.mapTo(page, QPoint()), values.size()))
    page.overlay.cursors.click()
    assert not values.isVisible()


def test_the_plots_are_saved_as_they_are_on_the_screen_from_a_menu_of_their_own(
    page: LookPage, until: Until, qtbot: QtBot, tmp_path: Path
) -> None:
    choose(page, until, 0)
    plot = page.overlay.channel_plot
    view = plot.widget.viewport()
    qtbot.mouseClick(view, Qt.MouseButton.RightButton, pos=view.rect().center())
    until(lambda: isinstance(QApplication.activePopupWidget(), QMenu))
    menu = QApplication.activePopupWidget()
    assert isinstance(menu, QMenu)
    assert [action.text() for action in menu.actions()] == ["Save the picture as PNG …", "Save the picture as SVG …"]
    for action in menu.actions():
        action.trigger()
        (dialog,) = (asked for asked in plot.widget.findChildren(QFileDialog) if asked.isVisible())
        file = tmp_path / f"force.{dialog.defaultSuffix()}"
        dialog.fileSelected.emit(str(file))
        dialog.close()
    menu.close()
    height = sum(shown.widget.height() for shown in (page.overlay.channel_plot, page.overlay.speed_plot))
    with Image.open(tmp_path / "force.png") as picture:
        assert picture.size == (4 * plot.widget.width(), 4 * height)
        assert len(picture.convert("RGB").getcolors(1 << 24) or ()) > 10, "nothing is drawn"
    svg = (tmp_path / "force.svg").read_text("utf-8")
    assert all(words in svg for words in ("Force (mN)", "mm/s", "Time (s)"))
    clips = re.findall(r'id="([^"]*clip)"', svg)
    assert len(set(clips)) == len(clips) == 2  # or one plot would be cut to the other's size
    assert "saved as png, svg" in save_picture(str(tmp_path / "force.pdf"), plot.picture)


def test_show_all_undoes_the_zoom(page: LookPage, until: Until) -> None:
    choose(page, until, 0)
    whole = page.overlay.speed_plot.shown()
    page.overlay.speed_plot.show_times(1.0, 1.2)
    assert page.overlay.channel_plot.shown()[1] < 1.3
    press(page.overlay.fit)
    assert page.overlay.speed_plot.shown() == pytest.approx(whole, abs=0.05)


def test_the_channel_can_be_changed_and_the_raw_trace_hidden(page: LookPage, until: Until) -> None:
    choose(page, until, 0)
    page.overlay.channel.setCurrentText("position")
    assert len(page.overlay.channel_plot.lines) == 2
    page.overlay.raw.click()
    assert len(page.overlay.channel_plot.lines) == 1


def test_drags_at_several_speeds_lie_over_each_other_along_the_way(page: LookPage, until: Until) -> None:
    choose(page, until, 0, 2)
    page.overlay.axis.setCurrentText("position")
    assert page.overlay.speed_plot.shown() == pytest.approx((40.0, 50.0), abs=0.5)
    page.overlay.raw.click()
    for line, trace in zip(page.overlay.channel_plot.lines, page.overlay.traces, strict=True):
        x, y = line.drawn.getData()
        assert (x.min(), x.max()) == pytest.approx((40.0, 50.0), abs=0.05)
        at = int(np.argmin(abs(trace.channels["position"] - 45.0)))
        assert y[np.argmin(abs(x - 45.0))] == pytest.approx(trace.filtered["force"][at], abs=3.0)
    page.overlay.cursors.click()
    page.overlay.place_cursors(45.0, 60.0)
    values = page.overlay.values
    assert [values.item(row, 0).text().split(":")[0] for row in range(3)] == [
        "position (mm)",
        "0  drag 5 mm/s",
        "2  drag 20 mm/s",
    ]
    assert values.item(1, 2).text() == "no sample"
    for row, trace in enumerate(page.overlay.traces, 1):
        passed = int(np.argmax(trace.channels["position"] >= 45.0))
        assert float(values.item(row, 1).text()) == pytest.approx(trace.filtered["force"][passed], abs=1.0)
    page.overlay.axis.setCurrentText("speed")
    assert page.overlay.speed_plot.shown()[1] == pytest.approx(20.0, abs=1.5)
    page.overlay.axis.setCurrentText("time")
    assert page.overlay.speed_plot.shown()[1] > 2.0


def test_steady_forces_are_drawn_against_speed_and_are_those_of_the_table(
    page: LookPage, until: Until, folder: Path
) -> None:
    choose(page, until, 0, 2)
    drags = dragrig.table(folder / "first").iloc[[0, 2]]
    speeds, forces = page.steady.plot.lines[0].drawn.getOriginalDataset()
    assert [float(10**place) for place in speeds] == pytest.approx([5.0, 20.0])
    assert list(forces) == pytest.approx(drags["steady_above_rest_mN"].tolist())
    shown = [
        item.text()
        for sheet in page.steady.view.findChildren(QTableWidget)
        for item in sheet.findItems("", Qt.MatchFlag.MatchContains)
    ]
    assert drags["file"].tolist() == [text for text in shown if text.endswith(".h5")]


@pytest.mark.parametrize("name", ["CSV", *(thorough(name) for name in FORMATS if name != "CSV")])
def test_selected_runs_are_exported_from_the_menu(page: LookPage, until: Until, name: str, tmp_path: Path) -> None:
    assert f"{name} …" in [action.text() for action in page.menu.actions()]
    choose(page, until, 0, 1)
    assert page.export.isEnabled()
    page.export_to(tmp_path, name)
    until(lambda: "written" in page.state.text())
    assert len(list(tmp_path.iterdir())) == 2


def test_leaving_the_folder_field_keeps_what_is_selected(page: LookPage, until: Until) -> None:
    choose(page, until, 0)
    page.browser.folder.editingFinished.emit()
    assert not page.browser.busy
    assert len(page.browser.selected()) == 1


def test_another_folder_can_be_opened(page: LookPage, until: Until, tmp_path: Path) -> None:
    page.browser.open_folder(str(tmp_path))
    until(lambda: not top_items(page.browser.tree))
    press(page.browser.again)
    assert not page.browser.selected()


def test_campaigns_opened_at_once_are_all_loaded(page: LookPage, until: Until, folder: Path, tmp_path: Path) -> None:
    run = next((folder / "first").glob("*.h5"))
    for name in ("one", "two", "three"):
        (tmp_path / name).mkdir()
        shutil.copy(run, tmp_path / name)
    page.browser.open_folder(str(tmp_path))
    page.browser.folder.setText("half a new pa")  # typed on while the folder before is still being listed
    until(lambda: len(top_items(page.browser.tree)) == 3)
    for item in top_items(page.browser.tree):
        item.setExpanded(True)
    until(lambda: [item.childCount() for item in top_items(page.browser.tree)] == [1, 1, 1])


def test_the_list_follows_what_is_recorded_and_keeps_what_is_selected(
    page: LookPage, until: Until, folder: Path, tmp_path: Path
) -> None:
    first, *later = sorted((folder / "first").glob("*.h5"))
    (tmp_path / "old").mkdir()
    shutil.copy(first, tmp_path / "old")
    page.browser.open_folder(str(tmp_path))
    until(lambda: len(runs_of(page)) == 1)
    choose(page, until, 0)
    shown = page.overlay.traces[0]
    for run in later:
        shutil.copy(run, tmp_path / "old")
    (tmp_path / "new").mkdir()
    until(lambda: str(tmp_path / "new") in page.browser.changes.directories())
    shutil.copy(first, tmp_path / "new")
    until(lambda: len(runs_of(page)) == 4 and len(top_items(page.browser.tree)) == 2)
    assert [item.text(0) for item in top_items(page.browser.tree)] == ["old", "new"]
    assert [run.path for run in page.browser.selected()] == [tmp_path / "old" / first.name]
    assert page.overlay.traces[0] is shown, "what is looked at is not read again"


def test_runs_are_marked_bad_and_noted_in_the_list(page: LookPage, until: Until, folder: Path, tmp_path: Path) -> None:
    for run in sorted((folder / "first").glob("*-drag-*.h5")):
        shutil.copy(run, tmp_path)
    page.browser.open_folder(str(tmp_path))
    until(lambda: len(runs_of(page)) == 2)
    page.browser.tree.clearSelection()
    assert not page.browser.bad.isEnabled()
    choose(page, until, 0, 1)
    said: list[str] = []
    page.browser.complained.connect(said.append)
    press(page.browser.bad)
    until(lambda: bool(said))
    assert "no reason is given" in said[0]
    page.browser.words.setText("the capsule slipped")
    press(page.browser.bad)
    until(lambda: [item.text(2) for item in runs_of(page)].count("BAD: the capsule slipped") == 2)
    until(lambda: [row.mark for row in page.steady.rows] == ["the capsule slipped"] * 2)
    assert not dragrig.campaign(tmp_path).good
    choose(page, until, 0)
    page.browser.words.setText("wall looked dry")
    press(page.browser.note)
    until(lambda: runs_of(page)[0].text(2) == "BAD: the capsule slipped; wall looked dry")
    press(page.browser.good)
    until(lambda: runs_of(page)[0].text(2) == "complete; wall looked dry")
    assert not page.browser.good.isEnabled()
    press(page.browser.note)
    until(lambda: runs_of(page)[0].text(2) == "complete")
    assert not list(tmp_path.glob("*.note.txt"))


def test_runs_are_found_by_words_and_unreadable_files_are_shown(page: LookPage, until: Until, tmp_path: Path) -> None:
    copied_runs(tmp_path / "camp", "005-blank.h5", "010-drag.h5", "018-drag.h5")
    (tmp_path / "camp" / "garbage.h5").write_bytes(b"nothing")
    mark_bad(tmp_path / "camp" / "018-drag.h5", "slipped")
    page.browser.open_folder(str(tmp_path))
    until(lambda: len(runs_of(page)) == 4)
    assert runs_of(page)[-1].text(0) == UNREADABLE
    assert "garbage.h5" in runs_of(page)[-1].toolTip(2)
    assert top_items(page.browser.tree)[0].text(2).startswith("3 runs · ")

    def found() -> list[str]:
        return [item.text(0).split()[1] for item in runs_of(page)[:3] if not item.isHidden()]

    for words, kinds in (("DRAG", ["drag", "drag"]), ("drag bad", ["drag"])):
        page.browser.words_to_find.setText(words)
        page.browser.words_to_find.returnPressed.emit()
        until(lambda kinds=kinds: found() == kinds)
    said: list[str] = []
    page.browser.complained.connect(said.append)
    page.browser.words_to_find.setText("nobody 1999-01-01")
    page.browser.words_to_find.returnPressed.emit()
    until(lambda: not top_items(page.browser.tree) and bool(said))
    assert "no run is of all that" in said[-1]
    page.browser.words_to_find.clear()


@pytest.mark.thorough  # all windows that tests have left in this process change their style with it
def test_plots_and_texts_are_light_on_a_dark_desktop(page: LookPage, qapp: QApplication) -> None:
    def paper_and_text() -> list[int]:
        plot = page.overlay.channel_plot.widget
        text = page.browser.words_to_find.palette().color(QPalette.ColorRole.Text)
        return [plot.backgroundBrush().color().lightness(), text.lightness()]

    light = paper_and_text()
    with pytest.MonkeyPatch.context() as desktop:
        desktop.setattr(widgets, "desktop_is_dark", lambda: True)  # no desktop of a test's can be asked to be
        qapp.styleHints().colorSchemeChanged.emit(Qt.ColorScheme.Dark)
        paper, text = paper_and_text()
        assert paper < 64
        assert text > 192
    qapp.styleHints().colorSchemeChanged.emit(Qt.ColorScheme.Light)
    assert paper_and_text() == light
    assert light[1] < light[0]


def test_what_a_crash_left_is_recovered_in_the_list(page: LookPage, until: Until, tmp_path: Path) -> None:
    recording = record(tmp_path / "run.h5", 2000)
    page.browser.open_folder(str(tmp_path))
    until(lambda: [item.text(2) for item in runs_of(page)] == ["being recorded, or left by a crash"])
    press(page.browser.recover)
    until(lambda: [item.text(2) for item in runs_of(page)] == ["complete"])
    assert not recording.exists()
    assert not page.browser.recover.isEnabled()
    with lock_run(record(tmp_path / "now.h5", 2000)):  # as whoever records it does
        said: list[str] = []
        page.browser.complained.connect(said.append)
        page.browser.refresh()
        until(lambda: len(runs_of(page)) == 2)
        press(page.browser.recover)
        until(lambda: bool(said))
        assert "now" in said[0]


def test_a_later_export_does_not_drop_an_earlier_one(page: LookPage, until: Until, tmp_path: Path) -> None:
    choose(page, until, 0)
    names = list(FORMATS)[:2]
    for name in names:
        (tmp_path / name).mkdir()
        page.export_to(tmp_path / name, name)
    until(lambda: not page.exporting.busy)
    assert [len(list((tmp_path / name).iterdir())) for name in names] == [1, 1]


def test_lost_samples_stay_a_gap(folder: Path) -> None:
    trace = shown_trace(sorted((folder / "first").glob("*.h5"))[0])
    assert len(trace.channels["force"]) == len(trace.filtered["speed"])
    assert not np.isnan(trace.channels["force"]).any()


WITHOUT_PICTURES = CompletedDiagnosis(STRIBECK, without_pictures(diagnosis_document(STRIBECK).without("before-after")))


@pytest.fixture
def diagnose(qapp: QApplication, remembered: StoredSettings) -> Iterator[DiagnosePage]:
    dressed()
    made = DiagnosePage(remembered)
    made.show()
    yield made
    made.keep()
    made.close()


def test_a_diagnosis_is_shown_completely(diagnose: DiagnosePage) -> None:
    results = diagnose.results
    results.show_diagnosis(WITHOUT_PICTURES)
    texts = "\n".join(label.text() for label in results.view.findChildren(QLabel))
    assert "0.93" in texts
    assert "payload inertia" in texts
    assert results.runs.count() == len(STRIBECK.traces)
    for at in range(results.runs.count()):
        results.runs.setCurrentIndex(at)
        assert len(results.above.lines) == 3
    assert results.view.findChildren(DrawnFigure)
    assert results.next.isHidden() == (STRIBECK.next_experiment is None)


def test_a_folder_without_runs_cannot_be_diagnosed(diagnose: DiagnosePage, until: Until, tmp_path: Path) -> None:
    text: list[str] = []
    diagnose.complained.connect(text.append)
    assert not diagnose.start.isEnabled()
    diagnose.offer(str(tmp_path / "nothing"))
    press(diagnose.start)
    until(lambda: bool(text))
    assert "nothing" in text[0]
    assert diagnose.start.isEnabled()


def test_a_diagnosis_can_be_cancelled(diagnose: DiagnosePage, folder: Path) -> None:
    diagnose.offer(str(folder / "first"))
    press(diagnose.start)
    assert diagnose.busy
    press(diagnose.cancel)
    assert not diagnose.busy
    assert diagnose.state.text() == "Cancelled."


def test_the_next_experiment_is_handed_on_as_a_plan(diagnose: DiagnosePage) -> None:
    from dataclasses import replace

    from dragrig.analysis.gap.diagnosis import NextExperiment, NextRun, OpenCauses
    from dragrig.config.plan import PlanStep

    step = PlanStep.model_validate({"kind": "drag", "speed_mm_s": 2.0, "travel_mm": 30.0})
    next_experiment = NextExperiment((NextRun(step, 2.0, 0.5),), 12, "A slow drag tells them apart.")
    settled = replace(STRIBECK, open_causes=OpenCauses({}, 0.0, 0.99, 0.1))
    diagnose.results.show_diagnosis(replace(WITHOUT_PICTURES, diagnosis=settled))
    assert diagnose.results.next_words.text() == "Nothing: no run would change the answer."
    assert diagnose.results.next.isHidden()
    diagnosis = replace(STRIBECK, next_experiment=next_experiment)
    diagnose.results.show_diagnosis(replace(WITHOUT_PICTURES, diagnosis=diagnosis))
    assert diagnose.results.next_words.text() == "A slow drag tells them apart."
    handed: list[object] = []
    diagnose.next_experiment.connect(lambda _, form: handed.append(form.plan.steps[0].parameters["speed_mm_s"]))
    press(diagnose.results.next)
    assert handed == [2.0]


def test_a_long_table_that_is_filled_again_does_not_hold_the_window_up(qapp: QApplication) -> None:
    long = table([f"column {number}" for number in range(12)])
    long.show()
    begun_s = time.thread_time()
    for _ in range(2):
        fill_table(long, [[f"text {row} {number}" for number in range(12)] for row in range(300)])
        qapp.processEvents()
    assert time.thread_time() - begun_s < 1.0
    assert long.columnWidth(0) > long.fontMetrics().horizontalAdvance("text 299 0")
    long.close()
