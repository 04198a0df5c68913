// A canvas that is moved and zoomed by mouse, wheel, fingers and code; whoever owns it draws and hears taps.

const STILL_PX = 5;

export class PanZoom {
  // limits: least and most scale, screen pixels a unit. draw(context): in CSS pixels. tap(x, y): in units.
  constructor(canvas, { limits, draw, tap }) {
    Object.assign(this, { canvas, limits, draw, tap, x: 0, y: 0, scale: 1, fingers: new Map() });
    this.context = canvas.getContext("2d");
    new ResizeObserver(() => this.resize()).observe(canvas);
    canvas.addEventListener("pointerdown", e => this.down(e));
    canvas.addEventListener("pointermove", e => this.move(e));
    for (const kind of ["pointerup", "pointercancel"]) canvas.addEventListener(kind, e => this.up(e));
    canvas.addEventListener("wheel", e => {
      e.preventDefault();
      this.zoom(2 ** (-e.deltaY / 300), e.offsetX, e.offsetY);
    }, { passive: false });
  }

  get width() { return this.canvas.clientWidth; }
  get height() { return this.canvas.clientHeight; }

  resize() {
    const dense = window.devicePixelRatio || 1;
    this.canvas.width = Math.round(this.width * dense);
    this.canvas.height = Math.round(this.height * dense);
    this.resized?.();
    this.redraw();
  }

  redraw() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      const dense = window.devicePixelRatio || 1;
      this.context.setTransform(dense, 0, 0, dense, 0, 0);
      this.context.clearRect(0, 0, this.width, this.height);
      this.draw(this.context);
    });
  }

  show(x, y, scale = this.scale) {
    Object.assign(this, { x, y, scale: Math.min(Math.max(scale, this.limits[0]), this.limits[1]) });
    this.redraw();
  }

  fit([left, top, right, bottom], margin = 0.05) {
    const scale = (1 - 2 * margin) * Math.min(this.width / (right - left || 1), this.height / (bottom - top || 1));
    this.show((left + right) / 2, (top + bottom) / 2, scale || 1);
  }

  zoom(factor, atX = this.width / 2, atY = this.height / 2) {
    const [x, y] = this.unit(atX, atY);
    this.show(this.x, this.y, this.scale * factor);
    const [newX, newY] = this.unit(atX, atY);
    this.show(this.x + x - newX, this.y + y - newY);
  }

  screen(x, y) { return [this.width / 2 + (x - this.x) * this.scale, this.height / 2 + (y - this.y) * this.scale]; }
  unit(x, y) { return [this.x + (x - this.width / 2) / this.scale, this.y + (y - this.height / 2) / this.scale]; }

  down(event) {
    this.canvas.setPointerCapture(event.pointerId);
    if (!this.fingers.size) this.moved = 0;
    this.fingers.set(event.pointerId, [event.offsetX, event.offsetY]);
    if (this.fingers.size > 1) this.moved = Infinity;
  }

  move(event) {
    const before = this.fingers.get(event.pointerId);
    if (!before) return;
    const now = [event.offsetX, event.offsetY], other = [...this.fingers].find(([id]) => id !== event.pointerId)?.[1];
    this.moved += distance(now, before);
    if (this.moved < STILL_PX) return;
    this.fingers.set(event.pointerId, now);
    const from = middle(before, other), to = middle(now, other);
    if (other) this.zoom(distance(now, other) / (distance(before, other) || 1), ...from);
    this.show(this.x - (to[0] - from[0]) / this.scale, this.y - (to[1] - from[1]) / this.scale);
  }

  up(event) {
    const known = this.fingers.delete(event.pointerId);
    if (known && event.type === "pointerup" && this.moved < STILL_PX) this.tap(...this.unit(event.offsetX, event.offsetY), event);
  }
}

const middle = (a, b = a) => [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2];
const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
