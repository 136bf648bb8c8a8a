"use strict";
const DOING = { preparing: "Makes the rig ready", asking: "Waits for a person", waiting: "Rests", recording: "Records",
  between: "Between two runs", ended: "Over", died: "Died" };
const put = (id, text) => { const one = document.getElementById(id); if (one.textContent !== text) one.textContent = text; };
const spell = (seconds) => {
  if (seconds === null || seconds === undefined) return "";
  const whole = Math.round(seconds), minutes = Math.floor(whole / 60);
  if (whole < 60) return `${whole} s`;
  return whole < 3600 ? `${minutes} min ${whole % 60} s` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
};
const number = (value, digits, unit) => value === null || value === undefined ? "" : `${value.toFixed(digits)} ${unit}`;
const draw = (recording) => {
  const some = recording && recording.recent_s.length > 1;
  document.getElementById("trace").hidden = !some;
  if (!some) return;
  const time = recording.recent_s, force = recording.recent_mN.map((one) => one ?? 0);
  const low = Math.min(...force), high = Math.max(...force), span = high - low || 1, length = time.at(-1) - time[0] || 1;
  const points = time.map((one, place) => `${(10 + 780 * (one - time[0]) / length).toFixed(1)},${(190 - 160 * (force[place] - low) / span).toFixed(1)}`);
  document.getElementById("line").setAttribute("points", points.join(" "));
  put("high", `${high.toFixed(1)} mN`);
  put("low", `${low.toFixed(1)} mN`);
};
const show = (state) => {
  const recording = state.recording;
  const badge = document.getElementById("backend");
  badge.className = `badge ${state.backend.split(",")[0]}`;
  put("backend", state.backend);
  put("plan", state.plan);
  put("campaign", state.campaign);
  const loud = ["asking", "died"].includes(state.doing);
  document.getElementById("said").hidden = !(state.said && loud);
  put("said", state.said);
  put("state", DOING[state.doing] + (state.status ? `, ${state.status}` : "") + (state.said && !loud ? `: ${state.said}` : ""));
  put("run", state.of === null ? "" : `${state.run} of ${state.of}`);
  put("left", spell(state.left_s) || "–");
  put("kind", recording?.kind ?? "–");
  put("phase", recording ? `${recording.phase}, ${spell(recording.time_s)}${recording.run_s === null ? "" : ` of ${spell(recording.run_s)}`}` : "–");
  put("force", recording ? number(recording.force_mN, 1, "mN") : "–");
  put("position", recording ? number(recording.position_mm, 3, "mm") : "–");
  put("samples", recording ? String(recording.samples) : "–");
  draw(recording);
  const table = document.getElementById("runs"), body = table.tBodies[0];
  table.hidden = !state.finished.length;
  document.getElementById("none").hidden = !table.hidden;
  for (const one of state.finished.slice(body.rows.length)) {
    const row = body.insertRow();
    [one.order, one.kind, one.reason ? `${one.status}: ${one.reason}` : one.status, one.samples, one.file].forEach((text, place) => {
      const cell = row.insertCell();
      cell.textContent = text;
      cell.className = place === 3 ? "number" : "still";
    });
  }
  document.title = `${DOING[state.doing]} · ${state.campaign}`;
};
let over = false;
const look = async () => {
  try {
    const state = await (await fetch("/state.json", { cache: "no-store" })).json();
    if ("doing" in state) {
      show(state);
      over = ["ended", "died"].includes(state.doing);
    }
  } catch {
    put("state", "Nobody follows the campaign any more: dragrig watch has ended.");
    over = true;
  }
  if (!over) setTimeout(look, 500);
};
look();
