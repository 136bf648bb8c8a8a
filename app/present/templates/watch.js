"use strict";
const DOING = { preparing: "Makes the rig ready", asking: "Waits for a person", waiting: "Rests", recording: "Records",
  between: "Between two runs", ended: "Over", died: "Died" };
const printable = (text) => String(text).replace(/(?![\n\t\u00ad\u200c\u200d])[\p{Cc}\p{Cf}\p{Cs}\p{Zl}\p{Zp}]/gu,
  (letter) => [...letter].map((unit) => `\\u${unit.codePointAt(0).toString(16).padStart(4, "0")}`).join(""));
const put = (id, raw) => {
  const one = document.getElementById(id), text = printable(raw);
  if (one.textContent !== text) one.textContent = text;
};
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
      cell.textContent = printable(text);
      cell.className = place === 3 ? "number" : "still";
    });
  }
  document.title = printable(`${DOING[state.doing]} · ${state.campaign}`);
};
const asked = new URLSearchParams({
  tab: Math.random().toString(36).slice(2), token: new URLSearchParams(location.search).get("token") ?? "",
});
const reach = (path, more) => fetch(`${path}?${asked}`, { cache: "no-store", ...more });
const count = (runs) => {
  const counts = new Map();
  for (const run of runs) counts.set(run.status, (counts.get(run.status) ?? 0) + 1);
  return [...counts].map(([status, number]) => `${number} ${status}`).join(", ") || "none";
};
let over = false, answered = new Date();
const look = async () => {
  try {
    const answer = await reach("/state.json");
    if (!answer.ok) throw new Error(answer.statusText);
    const state = await answer.json();
    answered = new Date();
    if ("doing" in state) {
      show(state);
      over = ["ended", "died"].includes(state.doing);
      put("measure", over ? "Run files" : "Left");
      if (over) put("left", count(state.finished));
    }
  } catch {
    put("state", `No answer from dragrig watch since ${answered.toLocaleTimeString()}; what is below is of then.`);
    document.title = "No answer · dragrig watch";
  }
  if (!over) setTimeout(look, 500);
};
addEventListener("pagehide", () => { if (!over) reach("/closed", { keepalive: true }).catch(() => {}); });
look();
