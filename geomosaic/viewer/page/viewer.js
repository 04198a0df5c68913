// The page: what is shown of a run or two, and what is measured. Every measure is the server's, by the runs' own rasters.

import { MapCanvas } from "./map_canvas.js";
import { KINDS, headline, lines, profilePlot } from "./measures.js";

const $ = id => document.getElementById(id);
const COLOURS = ["#ffd23f", "#5cc8ff", "#ff8ad8", "#8be36b", "#ffa45c", "#c9a6ff"];
const shown = await (await fetch("runs")).json(), two = shown.runs.length > 1;
let kind = null, draft = [], measures = [], made = 0, asked = 0;

const map = new MapCanvas($("map"), shown, (col, row) => clicked([col, row]));

function element(tag, of = {}, ...inside) {
  const node = Object.assign(document.createElement(tag), of);
  node.append(...inside);
  return node;
}

// What each run says of a measure; an answer that is an error stands for itself.
function measure(name, points) {
  return Promise.all(shown.runs.map(async (_, run) => {
    try {
      const body = JSON.stringify({ run, kind: name, points });
      return await (await fetch("measure", { method: "POST", headers: { "Content-Type": "application/json" }, body })).json();
    } catch {
      return { error: "geomosaic open does not answer. Start it again and open the address that it prints." };
    }
  }));
}

function clicked(at) {
  if (!kind) return;
  const last = draft.at(-1), near = last && Math.hypot(at[0] - last[0], at[1] - last[1]) * map.scale < 6;
  if (near) return void done();
  draft.push(at);
  if (draft.length === kind.most) done();
  else render();
}

async function done() {
  if (!kind || draft.length < kind.least) return;
  const { name, title, closed } = kind, points = draft;
  draft = [];
  render();
  const found = await measure(name, points);
  made += 1;
  measures.unshift({ kind: name, name: `${title} ${made}`, closed, points, found, colour: COLOURS[made % COLOURS.length] });
  render();
}

async function hint() {
  if (!kind) return;
  const number = ++asked, least = kind.least - draft.length;
  $("hint").className = "";
  $("hint").textContent = least > 0 ? (draft.length ? `${least} more ${least > 1 ? "points" : "point"}` : `${kind.title}: click ${kind.most === 1 ? "it" : "its points"}`) : "...";
  if (least > 0) return;
  const [found] = await measure(kind.name === "profile" ? "distance" : kind.name, draft);
  if (number !== asked) return;
  $("hint").textContent = headline(kind.name, found);
  $("hint").classList.toggle("error", Boolean(found.error));
}

function choose(next) {
  kind = kind === next ? null : next;
  draft = [];
  render();
}

function undo() {
  draft.pop();
  render();
}

function card(of) {
  const head = element("h2", {}, element("i"), element("span", {}, of.name), element("button", { title: "remove this measure", ariaLabel: `remove ${of.name}`, onclick: () => { measures = measures.filter(m => m !== of); render(); } }, "✕"));
  head.firstChild.style.background = of.colour;
  const parts = of.found.flatMap((found, run) => {
    const list = element("dl", {}, ...lines(of.kind, found).flatMap(([label, words]) => [element("dt", {}, label), element("dd", {}, words)]));
    return [...(two ? [element("h3", {}, shown.runs[run].name)] : []), list, ...(found.profile ? [profilePlot(found.profile)] : [])];
  });
  return element("article", { className: "measure" }, head, ...parts);
}

function render() {
  for (const button of $("tools").children) button.setAttribute("aria-pressed", button.dataset.kind === kind?.name);
  $("draft").hidden = !kind;
  $("undo").disabled = !draft.length;
  $("done").disabled = !kind || draft.length < kind.least;
  const unmeasured = shown.runs.map(run => run.unmeasured).find(Boolean);
  $("measures").replaceChildren(...measures.map(card), ...(measures.length ? [] : [element("p", {}, unmeasured || "Choose what to measure above, then click on the map.")]));
  map.update({ measures: [...measures, ...(draft.length ? [{ points: draft, closed: kind.closed, colour: "#ffffff", name: "" }] : [])] });
  hint();
}

const layers = new Map(shown.runs.flatMap(run => run.layers).reverse().map(layer => [layer.name, layer]));

function base(name) {
  const legend = layers.get(name)?.legend;
  $("legend").hidden = !legend;
  if (legend) {
    [$("low").textContent, $("high").textContent] = legend;
    $("ramp").style.background = `linear-gradient(to right, ${legend[2].join(", ")})`;
  }
  map.update({ base: name });
}

function swipe(share) {
  const at = Math.min(Math.max(share, 0), 1);
  $("swipe").style.left = `${100 * at}%`;
  $("swipe").ariaValueNow = Math.round(100 * at);
  map.update({ swipe: at });
}

for (const of of KINDS) {
  const button = element("button", { title: `${of.title.toLowerCase()} (${of.key.toUpperCase()})`, onclick: () => choose(of) }, of.title);
  button.dataset.kind = of.name;
  $("tools").append(button);
}
for (const { name, title } of layers.values())
  $("bases").append(element("label", {}, element("input", { type: "radio", name: "base", value: name, checked: name === "mosaic", onchange: () => base(name) }), title));
for (const { title, colour } of new Map(shown.runs.flatMap(run => run.features).map(of => [of.title, of])).values()) {
  const mark = element("i"), box = element("input", { type: "checkbox", value: title, onchange: () => { map.features[box.checked ? "add" : "delete"](title); map.redraw(); } });
  mark.style.background = colour;
  $("features").append(element("label", {}, box, mark, title));
}
$("name").textContent = document.title = shown.runs.map(run => run.name).join(" | ");
$("rules").append(...shown.rules.map(rule => element("li", {}, rule)));
$("undo").onclick = undo;
$("done").onclick = done;

$("layers").open = innerWidth > 760;

if (two) {
  for (const [id, run] of [["left", 0], ["right", 1]]) Object.assign($(id), { hidden: false, textContent: shown.runs[run].name });
  $("swipe").hidden = false;
  $("swipe").onpointerdown = event => $("swipe").setPointerCapture(event.pointerId);
  $("swipe").onpointermove = event => $("swipe").hasPointerCapture(event.pointerId) && swipe((event.clientX - $("view").getBoundingClientRect().left) / map.width);
  $("swipe").onkeydown = event => {
    const by = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
    if (!by) return;
    swipe(map.swipe + by);
    event.preventDefault();
    event.stopPropagation();
  };
  swipe(0.5);
}

$("map").addEventListener("pointermove", event => {
  const at = map.unit(event.offsetX, event.offsetY), [east, north] = at.map((v, k) => shown.origin[k] + shown.pixel[k] * v);
  $("place").textContent = shown.on_map ? `${east.toFixed(2)} E, ${north.toFixed(2)} N` : `column ${at[0].toFixed(1)}, row ${at[1].toFixed(1)}`;
});
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const KEYS = {
  enter: done, backspace: undo, escape: () => (draft.length ? (draft = [], render()) : kind && choose(kind)),
  "+": () => map.zoom(1.5), "=": () => map.zoom(1.5), "-": () => map.zoom(1 / 1.5), 1: () => map.show(map.x, map.y, 1), 0: () => map.whole(),
  ...Object.fromEntries(KINDS.map(of => [of.key, () => choose(of)])),
};
addEventListener("keydown", event => {
  const control = event.target.closest?.("button, input, summary");
  if (event.ctrlKey || event.metaKey || event.altKey || (control && (["Enter", " "].includes(event.key) || ARROWS[event.key]))) return;
  const by = (event.shiftKey ? 200 : 40) / map.scale, arrow = ARROWS[event.key], act = KEYS[event.key.toLowerCase()];
  if (arrow) map.show(map.x + by * arrow[0], map.y + by * arrow[1]);
  else if (act) act();
  else return;
  event.preventDefault();
});
render();
