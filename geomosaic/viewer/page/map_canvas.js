// The map: tiles that the server cuts from the runs' rasters, their features, and what is measured. Units are the map's pixels.

import { PanZoom } from "./pan_zoom.js";

const MOST_TILES = 500;

export class MapCanvas extends PanZoom {
  // clicked(col, row): a place was clicked.
  constructor(canvas, shown, clicked) {
    super(canvas, { limits: [0.5 / Math.max(shown.width, shown.height) * 40, 24], draw: () => this.paint(), tap: clicked });
    const side = Math.max(shown.width, shown.height);
    Object.assign(this, { shown, tiles: new Map(), base: "mosaic", features: new Set(), swipe: 1, measures: [] });
    this.levels = [1];
    while (this.levels.at(-1) * shown.tile < side) this.levels.push(2 * this.levels.at(-1));
    this.paths = shown.runs.map(run => run.features.map(of => of.lines.reduce((path, line) => {
      line.forEach(([col, row], k) => (k ? path.lineTo(col, row) : path.moveTo(col, row)));
      return path;
    }, new Path2D())));
    this.resized = () => this.started || this.whole();
  }

  whole() {
    this.started = this.width > 0;
    this.fit([0, 0, this.shown.width, this.shown.height], 0.03);
  }

  update(of) {
    Object.assign(this, of);
    this.redraw();
  }

  tile(run, reduction, across, down) {
    const address = `tile/${run}/${this.base}/${reduction}/${across}/${down}`;
    let image = this.tiles.get(address);
    if (!image) {
      image = new Image();
      image.onload = () => this.redraw();
      image.src = address;
      if (this.tiles.size >= MOST_TILES) this.tiles.delete(this.tiles.keys().next().value);
    } else this.tiles.delete(address);
    this.tiles.set(address, image);
    return image;
  }

  paint() {
    this.shown.runs.forEach((run, k) => {
      const edge = this.swipe * this.width, [from, to] = k ? [edge, this.width] : [0, this.shown.runs.length > 1 ? edge : this.width];
      this.context.save();
      this.context.beginPath();
      this.context.rect(from, 0, to - from, this.height);
      this.context.clip();
      if (run.layers.some(layer => layer.name === this.base)) this.paintTiles(k, from, to);
      this.paintFeatures(run, k);
      this.context.restore();
    });
    for (const measure of this.measures) this.paintMeasure(measure);
    this.paintScale();
  }

  paintTiles(run, from, to) {
    const dense = window.devicePixelRatio || 1, coarse = this.levels.at(-1);
    const fine = this.levels.findLast(r => r * this.scale * dense <= 1.3) ?? 1;
    const side = this.shown.tile * fine, [left, top] = this.unit(from, 0), [right, bottom] = this.unit(to, this.height);
    const [cols, rows] = [this.shown.width, this.shown.height].map(size => Math.ceil(size / side));
    this.context.imageSmoothingEnabled = this.scale < 3;
    for (let down = Math.max(Math.floor(top / side), 0); down < rows && down * side < bottom; down++)
      for (let across = Math.max(Math.floor(left / side), 0); across < cols && across * side < right; across++) {
        const image = this.tile(run, fine, across, down), [x, y] = this.screen(across * side, down * side), k = fine * this.scale;
        if (image.naturalWidth) this.context.drawImage(image, x, y, image.naturalWidth * k, image.naturalHeight * k);
        else if (fine !== coarse) this.paintCoarse(this.tile(run, coarse, 0, 0), coarse, [across * side, down * side], side);
      }
  }

  // What a tile that is still to come shows, from the tile of the whole map.
  paintCoarse(image, coarse, [col, row], side) {
    const [width, height] = [Math.min(side, this.shown.width - col), Math.min(side, this.shown.height - row)];
    if (image.naturalWidth) this.context.drawImage(image, col / coarse, row / coarse, width / coarse, height / coarse, ...this.screen(col, row), width * this.scale, height * this.scale);
  }

  paintFeatures(run, k) {
    const context = this.context;
    run.features.forEach((of, i) => {
      if (!this.features.has(of.title)) return;
      context.save();
      context.translate(...this.screen(0, 0));
      context.scale(this.scale, this.scale);
      for (const [style, wide] of [["#0007", 3], [of.colour, 1.3]]) {
        Object.assign(context, { strokeStyle: style, lineWidth: wide / this.scale });
        context.stroke(this.paths[k][i]);
      }
      context.restore();
      const names = of.points.length <= 60 || this.scale > 0.5;
      for (const [col, row, name] of of.points) this.paintPoint(...this.screen(col, row), of.colour, names ? name : "");
    });
  }

  paintPoint(x, y, colour, name, size = 4) {
    if (x < -99 || y < -20 || x > this.width + 99 || y > this.height + 20) return;
    const context = this.context;
    context.beginPath();
    context.arc(x, y, size, 0, 7);
    Object.assign(context, { fillStyle: colour, strokeStyle: "#fff", lineWidth: 1.5 });
    context.fill();
    context.stroke();
    if (name) this.text(name, x, y - size - 5, "center");
  }

  text(words, x, y, align) {
    Object.assign(this.context, { font: "600 12px system-ui, sans-serif", textAlign: align, lineWidth: 3, strokeStyle: "#000c", fillStyle: "#fff", lineJoin: "round" });
    this.context.strokeText(words, x, y);
    this.context.fillText(words, x, y);
  }

  paintMeasure({ points, closed, colour, name }) {
    const context = this.context, at = points.map(p => this.screen(...p));
    context.beginPath();
    at.forEach(p => context.lineTo(...p));
    if (closed && at.length > 2) {
      context.closePath();
      Object.assign(context, { fillStyle: `${colour}33` }).fill();
    }
    for (const [style, wide] of [["#000a", 5], [colour, 2.5]]) Object.assign(context, { strokeStyle: style, lineWidth: wide }).stroke();
    at.forEach((p, k) => this.paintPoint(...p, colour, k ? "" : name, 4));
  }

  // A round length on the ground, or pixels where the map has no scale.
  paintScale() {
    const { pixel, on_map: onMap } = this.shown, unit = onMap ? pixel[0] : 1, most = 140 * unit / this.scale;
    const power = 10 ** Math.floor(Math.log10(most)), length = [5, 2, 1].map(k => k * power).find(v => v <= most), wide = length / unit * this.scale;
    const [x, y] = [14, this.height - 14];
    for (const [style, width] of [["#000a", 5], ["#fff", 2.5]]) {
      Object.assign(this.context, { strokeStyle: style, lineWidth: width });
      this.context.beginPath();
      for (const p of [[x, y - 5], [x, y], [x + wide, y], [x + wide, y - 5]]) this.context.lineTo(...p);
      this.context.stroke();
    }
    this.text(onMap ? (length < 1 ? `${+(100 * length).toPrecision(3)} cm` : length < 1000 ? `${length} m` : `${length / 1000} km`) : `${length} px`, x, y - 9, "left");
  }
}
