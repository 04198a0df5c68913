// One frame at any zoom, from tiles that the server cuts from the original file, with a point's places on it.

import { PanZoom } from "./pan_zoom.js";

const REDUCTIONS = [1, 2, 4, 8];
const MOST_TILES = 400;
const SMALL = 0.5;  // screen pixels a pixel, below which a click zooms in

export class FrameView extends PanZoom {
  // mark(col, row): a place was clicked. failed(text): a tile cannot be had.
  constructor(canvas, tilePx, { mark, failed }) {
    super(canvas, { limits: [0.02, 24], draw: () => this.paint(), tap: (...at) => this.clicked(...at) });
    Object.assign(this, { tilePx, mark, failed, tiles: new Map(), frame: null });
    this.resized = () => this.pending && this.go(...this.pending);
  }

  // number: the frame's; size: its width and height; at: col and row that come to the middle.
  open(number, size, at) {
    Object.assign(this, { frame: number, size, predicted: null, marked: null });
    this.go(at);
  }

  go(at) {
    this.pending = this.width ? null : [at];
    if (at) this.show(...at, Math.max(this.scale, 1));
    else this.whole();
  }

  whole() { if (this.frame !== null) this.fit([0, 0, ...this.size], 0.01); }

  places(predicted, marked) {
    Object.assign(this, { predicted, marked });
    this.redraw();
  }

  clicked(col, row) {
    if (this.frame === null) return;
    if (this.scale < SMALL) this.show(col, row, 1);
    else if (col >= 0 && row >= 0 && col <= this.size[0] && row <= this.size[1]) this.mark(col, row);
  }

  // Asks for the tile at a place before it is shown; of a place outside the frame there is none.
  preload(number, [col, row], [width, height]) {
    if (col < 0 || row < 0 || col >= width || row >= height) return;
    this.tile(number, 1, Math.floor(col / this.tilePx), Math.floor(row / this.tilePx));
  }

  tile(number, reduction, across, down) {
    const address = `tile/${number}/${reduction}/${across}/${down}`;
    let image = this.tiles.get(address);
    if (!image) {
      image = new Image();
      image.onload = () => this.redraw();
      image.onerror = () => this.failed(`Part of the frame cannot be read (${address})`);
      image.src = address;
      if (this.tiles.size >= MOST_TILES) this.tiles.delete(this.tiles.keys().next().value);
    } else this.tiles.delete(address);
    this.tiles.set(address, image);
    return image;
  }

  paint() {
    if (this.frame === null) return;
    const dense = window.devicePixelRatio || 1, fine = REDUCTIONS.findLast(r => r * this.scale * dense <= 1.3) ?? 1;
    this.context.imageSmoothingEnabled = this.scale < 2;
    for (const reduction of fine === 8 ? [8] : [8, fine]) this.paintTiles(reduction);
    if (this.predicted && !this.marked) this.paintPredicted(...this.screen(...this.predicted));
    if (this.marked) this.paintMark(...this.screen(...this.marked));
    this.paintMiddle();
  }

  paintTiles(reduction) {
    const side = this.tilePx * reduction, [left, top] = this.unit(0, 0), [right, bottom] = this.unit(this.width, this.height);
    const clamp = (value, size) => Math.min(Math.max(value, 0), size - 1e-6);
    for (let down = Math.floor(clamp(top, this.size[1]) / side); down * side < clamp(bottom, this.size[1]); down++)
      for (let across = Math.floor(clamp(left, this.size[0]) / side); across * side < clamp(right, this.size[0]); across++) {
        const image = this.tile(this.frame, reduction, across, down);
        if (!image.naturalWidth) continue;
        const [x, y] = this.screen(across * side, down * side), k = reduction * this.scale;
        this.context.drawImage(image, x, y, image.naturalWidth * k, image.naturalHeight * k);
      }
  }

  stroke(color, width, path) {
    for (const [style, wide] of [["#000b", width + 2.5], [color, width]]) {
      Object.assign(this.context, { strokeStyle: style, lineWidth: wide });
      this.context.beginPath();
      path(this.context);
      this.context.stroke();
    }
  }

  paintPredicted(x, y) {
    this.context.setLineDash([6, 5]);
    this.stroke("#5cc8ff", 1.5, c => c.arc(x, y, 26, 0, 7));
    this.context.setLineDash([]);
  }

  paintMark(x, y) {
    this.stroke("#ffd23f", 2, c => {
      arms(c, x, y, 4, 24);
      c.moveTo(x + 14, y);
      c.arc(x, y, 14, 0, 7);
    });
  }

  paintMiddle() {
    const [x, y] = [this.width / 2, this.height / 2];
    this.stroke("#fff", 1, c => arms(c, x, y, 32, 42));
  }
}

// Four arms of a cross from one distance to another, that leave its middle free.
function arms(context, x, y, from, to) {
  for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
    context.moveTo(x + from * dx, y + from * dy);
    context.lineTo(x + to * dx, y + to * dy);
  }
}
