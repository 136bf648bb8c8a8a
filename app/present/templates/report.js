"use strict";
// Tables: each heading becomes a button that sorts by its column, backwards when pressed again, and then as it was.
for (const table of document.querySelectorAll("table.sortable")) {
  const body = table.tBodies[0], asWas = [...body.rows];
  const key = (row, column) => {
    const cell = row.cells[column];
    if ("number" in cell.dataset) return cell.dataset.number === "" ? null : Number(cell.dataset.number);
    return cell.textContent.trim() || null;
  };
  const compare = (one, other) =>
    typeof one === "number" && typeof other === "number" ? one - other
      : String(one).localeCompare(String(other), "en", { numeric: true });
  const sort = (head, column) => {
    const next = { ascending: "descending", descending: "none" }[head.getAttribute("aria-sort")] ?? "ascending";
    for (const one of table.tHead.rows[0].cells) one.setAttribute("aria-sort", one === head ? next : "none");
    const sign = next === "descending" ? -1 : 1;
    const rows = next === "none" ? asWas : [...asWas].sort((one, other) => {
      const [left, right] = [key(one, column), key(other, column)];
      // What is missing stays at the end, whichever way.
      return left === null || right === null ? (left === null) - (right === null) : sign * compare(left, right);
    });
    body.append(...rows);
  };
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.title = "Sort by this column";
    button.append(...head.childNodes);
    head.append(button);
    head.setAttribute("aria-sort", "none");
    button.addEventListener("click", () => sort(head, column));
  });
}
// A table that is wider than the text takes the width of the window, then smaller letters as well; where both are too
// little, it is stacked: a row is its cells one after the other, each with its heading. On paper it is a table again.
const steps = [["broad"], ["broad", "dense"], ["stacked"]];
const asTables = () => {
  for (const box of document.querySelectorAll(".broad, .stacked")) box.classList.remove(...steps.flat());
};
const fit = () => {
  asTables();
  for (const step of steps) {
    const wide = [...document.querySelectorAll(".scroll:has(> table.sortable)")].filter(
      (box) => box.scrollWidth > box.clientWidth + 1);
    for (const box of wide) {
      box.classList.remove(...steps.flat());
      box.classList.add(...step);
    }
  }
};
addEventListener("resize", fit);
addEventListener("beforeprint", asTables);
addEventListener("afterprint", fit);
document.addEventListener("toggle", fit, true);
fit();
// A link into what is folded opens it.
const unfold = () => {
  const target = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (target) for (let one = target; one; one = one.parentElement) if (one.tagName === "DETAILS") one.open = true;
  if (target) target.scrollIntoView();
};
addEventListener("hashchange", unfold);
unfold();
// All of a section's folded parts at once.
for (const section of document.querySelectorAll("[data-folded]")) {
  const parts = section.querySelectorAll("details"), button = document.createElement("button");
  const say = () => { button.textContent = [...parts].every((one) => one.open) ? "Close all" : "Open all"; };
  button.type = "button";
  button.className = "fold";
  button.addEventListener("click", () => {
    const open = ![...parts].every((one) => one.open);
    for (const one of parts) one.open = open;
    say();
  });
  for (const one of parts) one.addEventListener("toggle", say);
  parts[0].before(button);
  say();
}
