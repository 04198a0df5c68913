// The page: points, the frames that show the chosen one, its marks. Every change is answered with the new state.

import { FrameView } from "./frame_view.js";
import { MapView } from "./map_view.js";

const $ = id => document.getElementById(id);
const survey = await (await fetch("survey")).json();
let state = await (await fetch("state")).json();
let point = null, frame = null, order = [];

const picture = new FrameView($("frame"), survey.tile, { mark: (...at) => setMark(at, $("always").checked), failed: text => say(text, true) });
const map = new MapView($("map"), survey, { choosePoint, chooseFrame });

function say(text, error = false) {
  $("status").textContent = text;
  $("status").classList.toggle("error", error);
}

async function change(path, asked, done) {
  try {
    const answer = await fetch(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(asked) });
    const found = await answer.json();
    if (found.error) return say(found.error, true);
    state = found;
    say(found.said || done);
    render();
  } catch {
    say("Not saved: geomosaic control does not answer. Start it again and open the address that it prints.", true);
  }
}

// The present point's entry of a frame; one without places where the frame is not expected to show it.
function entry(i = frame) {
  return state.points[point]?.frames.find(f => f.frame === i) ?? { frame: i, predicted: null, mark: null, off: null };
}

function setMark(at, refine = false) {
  if (point === null || frame === null) return say("Choose a point first.", true);
  return change("mark", { point, frame, at, refine }, at ? "Saved" : "Removed");
}

function choosePoint(k) {
  point = k;
  order = state.points[k].frames.map(f => f.frame);
  const first = order.find(i => !entry(i).mark) ?? order[0];
  if (first === undefined) render();
  else chooseFrame(first);
  document.querySelector(".point[aria-current=true]")?.scrollIntoView({ block: "nearest", inline: "nearest" });
}

function chooseFrame(i) {
  if (i < 0) return;
  frame = i;
  const { width, height } = survey.frames[i], { mark, predicted } = point === null ? {} : entry();
  picture.open(i, [width, height], mark ?? predicted);
  render();
  document.querySelector("#frames [aria-current=true]")?.scrollIntoView({ block: "nearest", inline: "nearest" });
  const next = order[order.indexOf(i) + 1], place = next === undefined ? null : entry(next).predicted;
  if (place) picture.preload(next, place, [survey.frames[next].width, survey.frames[next].height]);
}

function step(list, now, by) {
  const at = list.indexOf(now) + by;
  return list[Math.min(Math.max(at, 0), list.length - 1)];
}

const stepFrame = by => order.length && chooseFrame(step(order, frame, by));
const stepPoint = by => choosePoint(step([...survey.points.keys()], point ?? -1, by));
const switchKind = k => change("kind", { point: k, check: !state.points[k].check }, "Saved");

function element(tag, of = {}, ...inside) {
  const made = Object.assign(document.createElement(tag), of);
  made.append(...inside);
  return made;
}

function render() {
  const marks = state.points.map(p => p.frames.filter(f => f.mark).length);
  const checks = state.points.filter((p, k) => p.check && marks[k]).length, marked = marks.filter(Boolean).length;
  $("count").textContent = `${marks.reduce((a, b) => a + b, 0)} marks, ${marked} of ${marks.length} points, ${checks} check`;
  $("points").replaceChildren(...survey.points.map(({ name }, k) => {
    const { check, frames } = state.points[k], suspect = frames.some(f => f.suspect);
    const row = element("div", { className: "point" },
      element("button", { className: "name", onclick: () => choosePoint(k) }, name, element("small", {}, `${marks[k]} of ${frames.length}${suspect ? " !" : ""}`)),
      element("button", { className: `kind ${check ? "check" : "control"}`, title: "control or check point (C)", onclick: () => switchKind(k) }, check ? "check" : "control"));
    if (k === point) row.setAttribute("aria-current", "true");
    return row;
  }));
  const shown = point === null ? [] : state.points[point].frames.map(f => f.frame);
  order = [...order.filter(i => shown.includes(i) || i === frame), ...shown.filter(i => !order.includes(i))];
  $("frames").replaceChildren(...(order.length ? order.map(chip) : [element("p", {}, point === null ? "Choose a point." : "No frame is expected to show this point.")]));
  const now = point === null || frame === null ? {} : entry();
  picture.places(now.predicted, now.mark);
  map.update(state, point, frame);
  $("caption").textContent = frame === null ? "" : [survey.frames[frame].name, point === null ? "" : survey.points[point].name, now.mark ? `marked at ${now.mark.map(v => v.toFixed(2)).join(", ")}` : ""].filter(Boolean).join("  ·  ");
  for (const id of ["refine", "remove"]) $(id).disabled = !now.mark;
  $("mark").disabled = point === null || frame === null;
  for (const id of ["previous", "next"]) $(id).disabled = !order.length;
}

function chip(i) {
  const { mark, off, suspect } = entry(i);
  const made = element("button", { className: `${mark ? "marked" : ""} ${suspect ? "suspect" : ""}`, onclick: () => chooseFrame(i) }, survey.frames[i].name);
  if (mark && off !== null) made.append(element("b", { title: "distance from where the other marks predict it" }, `${off.toFixed(1)} px`));
  if (i === frame) made.setAttribute("aria-current", "true");
  return made;
}

const markMiddle = () => setMark([picture.x, picture.y], $("always").checked);
const refine = () => entry().mark && setMark(entry().mark, true);
const remove = () => entry().mark && setMark(null);
const KEYS = {
  n: () => stepFrame(1), p: () => stepFrame(-1), j: () => stepPoint(1), k: () => stepPoint(-1), Enter: markMiddle, r: refine,
  Delete: remove, Backspace: remove, c: () => point !== null && switchKind(point), "+": () => picture.zoom(1.5), "=": () => picture.zoom(1.5),
  "-": () => picture.zoom(1 / 1.5), 1: () => picture.show(picture.x, picture.y, 1), 0: () => picture.whole(),
};
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };

addEventListener("keydown", event => {
  const control = event.target.closest?.("button, input, summary");
  if (event.ctrlKey || event.metaKey || event.altKey || (control && ["Enter", " "].includes(event.key))) return;
  const key = event.key.length === 1 ? event.key.toLowerCase() : event.key, by = event.shiftKey ? 10 : 1;
  if (ARROWS[key]) picture.show(picture.x + by * ARROWS[key][0], picture.y + by * ARROWS[key][1]);
  else if (KEYS[key]) KEYS[key]();
  else return;
  event.preventDefault();
});

for (const [id, act] of Object.entries({ previous: () => stepFrame(-1), next: () => stepFrame(1), mark: markMiddle, refine, remove })) $(id).onclick = act;
$("always").checked = localStorage.getItem("refine") === "true";
$("always").onchange = event => localStorage.setItem("refine", event.target.checked);
$("files").append("Marks are saved at once to ", element("code", {}, `${survey.folder}/gcp.csv`), " and gcp_list.txt. Take them for a mosaic with ", element("code", {}, "--gcp"), `. Poses: ${survey.source}.`);
say(`Poses: ${survey.source}`);
render();
