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
// Below each figure: save it 180 mm wide, which fits two columns of most journals, as vectors or as pixels at 600 dpi.
const saved = { wide: 180, dpi: 600 };
const svgOf = (figure) => {
  const svg = figure.querySelector("svg").cloneNode(true);
  const [, , wide, tall] = svg.getAttribute("viewBox").split(/\s+/).map(Number), height = saved.wide * tall / wide;
  // The letters' outlines stand in the page once for all figures.
  const letters = document.createElementNS(svg.namespaceURI, "defs");
  for (const name of new Set([...svg.querySelectorAll("use")].map((one) => one.getAttribute("href").slice(1))))
    if (!svg.querySelector(`#${CSS.escape(name)}`)) letters.append(document.getElementById(name).cloneNode(true));
  svg.prepend(letters);
  for (const [key, value] of Object.entries({ width: `${saved.wide}mm`, height: `${height}mm`, "stroke-linejoin": "round" }))
    svg.setAttribute(key, value);
  return { text: new XMLSerializer().serializeToString(svg), height };
};
// A PNG says how large its pixels are in a chunk of its own, which a browser leaves out: 23622 to the metre are 600 dpi.
const pixelSize = new Uint8Array([0, 0, 0, 9, 112, 72, 89, 115, 0, 0, 92, 70, 0, 0, 92, 70, 1, 20, 148, 67, 65]);
const pngOf = async (figure) => {
  const { text, height } = svgOf(figure), picture = new Image(), canvas = document.createElement("canvas");
  picture.src = `data:image/svg+xml;charset=utf-8,${encodeURIComponent(text)}`;
  await picture.decode();
  [canvas.width, canvas.height] = [saved.wide, height].map((length) => Math.round(length / 25.4 * saved.dpi));
  canvas.getContext("2d").drawImage(picture, 0, 0, canvas.width, canvas.height);
  const png = await (await new Promise((done) => canvas.toBlob(done, "image/png"))).arrayBuffer();
  return new Blob([png.slice(0, 33), pixelSize, png.slice(33)], { type: "image/png" });
};
const download = (blob, name) => {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
};
for (const figure of document.querySelectorAll("figure[data-name]")) {
  const row = document.createElement("p"), name = figure.dataset.name;
  const add = (label, made, ending) => {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = label;
    button.addEventListener("click", async () => download(await made(figure), `${name}.${ending}`));
    row.append(button);
  };
  row.className = "save";
  row.title = "For one column of a journal, or as PDF: the command's --column single and --picture-format pdf";
  row.append(`Save figure, ${saved.wide} mm wide: `);
  add("SVG", async (one) => new Blob([svgOf(one).text], { type: "image/svg+xml" }), "svg");
  add(`PNG, ${saved.dpi} dpi`, pngOf, "png");
  figure.append(row);
}
