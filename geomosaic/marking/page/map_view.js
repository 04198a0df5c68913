// The plan: outlines of the frames and the surveyed points. North is up.

import { PanZoom } from "./pan_zoom.js";

const NEAR_PX = 18;

export class MapView extends PanZoom {
  // choosePoint(k), chooseFrame(i): one was clicked.
  constructor(canvas, survey, { choosePoint, chooseFrame }) {
    super(canvas, { limits: [1e-4, 1e3], draw: c => this.paint(c), tap: (...at) => this.clicked(...at) });
    Object.assign(this, { survey, choosePoint, chooseFrame, state: null, point: null, frame: null });
    const at = [...survey.frames.flatMap(f => f.outline), ...survey.points.flatMap(p => p.at ? [p.at] : [])].map(up);
    const [xs, ys] = [0, 1].map(k => at.map(p => p[k]));
    this.bounds = [least(xs), least(ys), -least(xs.map(x => -x)), -least(ys.map(y => -y))];
    this.resized = () => this.fit(this.bounds);
  }

  update(state, point, frame) {
    Object.assign(this, { state, point, frame });
    this.redraw();
  }

  clicked(x, y) {
    const away = at => this.scale * Math.hypot(at[0] - x, -at[1] - y);
    const nearest = places => places.reduce((best, at, k) => (at && (best < 0 || away(at) < away(places[best])) ? k : best), -1);
    const point = nearest(this.survey.points.map(p => p.at));
    if (point >= 0 && away(this.survey.points[point].at) <= NEAR_PX) this.choosePoint(point);
    else this.chooseFrame(nearest(this.survey.frames.map(f => f.at)));
  }

  paint(context) {
    if (!this.state) return;
    const shown = new Set(this.point === null ? [] : this.state.points[this.point].frames.map(f => f.frame));
    this.survey.frames.forEach((_, i) => shown.has(i) || i === this.frame || this.outline(context, i, "#ffffff30"));
    for (const i of shown) if (i !== this.frame) this.outline(context, i, "#5cc8ffb0");
    if (this.frame !== null) this.outline(context, this.frame, "#ffd23f", "#ffd23f26");
    this.survey.points.forEach(({ at }, k) => at && this.symbol(context, k));
  }

  outline(context, i, stroke, fill) {
    Object.assign(context, { strokeStyle: stroke, lineWidth: 1.2 });
    context.beginPath();
    for (const at of this.survey.frames[i].outline) context.lineTo(...this.screen(...up(at)));
    context.closePath();
    if (fill) Object.assign(context, { fillStyle: fill }).fill();
    context.stroke();
  }

  // A triangle for control, a square for check points; filled where there are marks.
  symbol(context, k) {
    const [x, y] = this.screen(...up(this.survey.points[k].at)), { check, frames } = this.state.points[k];
    const size = k === this.point ? 9 : 6, color = check ? "#4cc38a" : "#68b1f5";
    context.beginPath();
    if (check) context.rect(x - size * 0.85, y - size * 0.85, size * 1.7, size * 1.7);
    else for (const [dx, dy] of [[0, -1.1], [1, 0.8], [-1, 0.8]]) context.lineTo(x + size * dx, y + size * dy);
    context.closePath();
    Object.assign(context, { lineWidth: 4, strokeStyle: "#000c" }).stroke();
    Object.assign(context, { lineWidth: 2, strokeStyle: color, fillStyle: frames.some(f => f.mark) ? color : "#0009" });
    context.fill();
    context.stroke();
    Object.assign(context, { font: `${k === this.point ? 600 : 400} 12px system-ui, sans-serif`, lineWidth: 3, strokeStyle: "#000c", fillStyle: "#fff" });
    const right = x < this.width - 70;
    context.textAlign = right ? "left" : "right";
    const label = [this.survey.points[k].name, x + (right ? 12 : -12), y + 4];
    context.strokeText(...label);
    context.fillText(...label);
  }
}

const up = ([east, north]) => [east, -north];
const least = values => values.reduce((a, b) => Math.min(a, b), Infinity);
