"use strict";
(() => {
  const figure = document.getElementById("profile"), pick = document.getElementById("pick");
  const { cols, rows, pixel, low, step } = Object.fromEntries(
    ["cols", "rows", "pixel", "low", "step"].map((name) => [name, Number(figure.dataset[name])]));
  const UNKNOWN = 65535, SAMPLES = 400, WIDTH = 1000, HEIGHT = 300, LEFT = 56, BOTTOM = 34, TOP = 10;
  const grids = ["surface", "terrain"].map((name) => [name, heights(figure.dataset[name])]);
  const line = pick.querySelector("svg");
  let first = null;

  function heights(base64) {
    const bytes = Uint8Array.from(atob(base64), (c) => c.charCodeAt(0)), view = new DataView(bytes.buffer);
    return Float64Array.from({ length: bytes.length / 2 }, (_, k) => {
      const level = view.getUint16(2 * k, true);
      return level === UNKNOWN ? NaN : low + step * level;
    });
  }

  // Bilinear between the middles of pixels; NaN next to an unknown one.
  function at(grid, x, y) {
    const u = Math.min(Math.max(x - 0.5, 0), cols - 1), v = Math.min(Math.max(y - 0.5, 0), rows - 1);
    const c = Math.min(Math.floor(u), Math.max(cols - 2, 0)), r = Math.min(Math.floor(v), Math.max(rows - 2, 0));
    const right = Math.min(c + 1, cols - 1), below = Math.min(r + 1, rows - 1), s = u - c, t = v - r;
    return (1 - t) * ((1 - s) * grid[r * cols + c] + s * grid[r * cols + right])
      + t * ((1 - s) * grid[below * cols + c] + s * grid[below * cols + right]);
  }

  function ticks(from, to, about) {
    const rough = Math.max((to - from) / about, 1e-9), power = 10 ** Math.floor(Math.log10(rough));
    const by = [1, 2, 5, 10].map((m) => m * power).find((b) => b >= rough);
    const found = [];
    for (let k = Math.ceil(from / by); k * by <= to + 1e-9; k++) found.push(k * by);
    return found.map((value) => [value, value.toFixed(Math.max(0, -Math.floor(Math.log10(by) + 1e-9)))]);
  }

  function element(name, attributes, text) {
    const made = document.createElementNS("http://www.w3.org/2000/svg", name);
    for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
    if (text !== undefined) made.textContent = text;
    return made;
  }

  function mark(a, b) {
    const ends = { x1: a[0], y1: a[1], x2: b[0], y2: b[1], "stroke-linecap": "round" };
    line.replaceChildren(element("line", { ...ends, class: "edge" }), element("line", ends));
  }

  function draw(a, b) {
    mark(a, b);
    const metres = Math.hypot(b[0] - a[0], b[1] - a[1]) * pixel;
    const lines = grids.map(([name, grid]) => [name, Array.from({ length: SAMPLES + 1 }, (_, k) => {
      const s = k / SAMPLES;
      return at(grid, a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1]));
    })]);
    const known = lines.flatMap(([, values]) => values.filter((h) => !Number.isNaN(h)));
    const plot = element("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}` });
    const place = document.getElementById("profile-plot");
    place.replaceChildren(plot);
    if (!known.length || !metres) {
      plot.append(element("text", { x: LEFT, y: 40 }, "Nothing is known along this line."));
      return;
    }
    const lowest = Math.min(...known), highest = Math.max(...known), room = Math.max(0.05 * (highest - lowest), 0.1);
    const [bottom, top] = [lowest - room, highest + room];
    const x = (m) => LEFT + (m / metres) * (WIDTH - LEFT - 12);
    const y = (h) => TOP + ((top - h) / (top - bottom)) * (HEIGHT - TOP - BOTTOM);
    for (const [h, words] of ticks(bottom, top, 5)) {
      plot.append(element("line", { class: "grid", x1: LEFT, x2: WIDTH - 12, y1: y(h), y2: y(h) }));
      plot.append(element("text", { x: LEFT - 6, y: y(h) + 4, "text-anchor": "end" }, words));
    }
    for (const [m, words] of ticks(0, metres, 8)) {
      plot.append(element("line", { class: "grid", x1: x(m), x2: x(m), y1: TOP, y2: HEIGHT - BOTTOM }));
      plot.append(element("text", { x: x(m), y: HEIGHT - BOTTOM + 16, "text-anchor": "middle" }, words));
    }
    plot.append(element("text", { x: WIDTH - 12, y: HEIGHT - 3, "text-anchor": "end" }, "distance, m"));
    plot.append(element("text", { x: 2, y: HEIGHT - 3 }, "height, m"));
    for (const [name, values] of lines.reverse()) {
      let path = "", open = false;
      values.forEach((h, k) => {
        path += Number.isNaN(h) ? "" : `${open ? "L" : "M"}${x((k / SAMPLES) * metres).toFixed(1)},${y(h).toFixed(1)}`;
        open = !Number.isNaN(h);
      });
      plot.append(element("path", { class: `of-${name}`, d: path }));
    }
    place.setAttribute("aria-label",
      `profile of ${metres.toFixed(1)} m, heights from ${lowest.toFixed(2)} to ${highest.toFixed(2)} m`);
  }

  pick.addEventListener("click", (event) => {
    const box = pick.getBoundingClientRect();
    const here = [((event.clientX - box.left) / box.width) * cols, ((event.clientY - box.top) / box.height) * rows];
    if (first) {
      draw(first, here);
      first = null;
    } else {
      first = here;
      mark(here, here);
    }
  });
  draw([0.5, rows / 2], [cols - 0.5, rows / 2]);
})();
