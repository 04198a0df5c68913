"use strict";
(() => {
  const get = (id) => document.getElementById(id);
  const data = JSON.parse(get("map-data").textContent);
  const ODD = "#ff7a1a", CHOSEN = "#1d9bf0", FADED = 0.12;
  const element = (name, properties, ...content) => {
    const made = Object.assign(document.createElement(name), properties);
    made.append(...content);
    return made;
  };
  const rows = [...get("rows").tBodies[0].rows], rowOf = new Map(rows.map((r) => [Number(r.dataset.row), r]));
  const shapes = new Map();  // of each row: what is drawn for it, with its style
  const outlines = new Map();  // of each row: what is marked when it is chosen

  // On paper: the mosaic once more, and everything unfolded.
  if (get("plate-image")) get("plate-image").setAttribute("href", get("mosaic-image").src);
  let folded = [];
  addEventListener("beforeprint", () => {
    folded = [...document.querySelectorAll("main details:not([open], .layers, #time details)")];
    folded.forEach((one) => { one.open = true; });
  });
  addEventListener("afterprint", () => folded.forEach((one) => { one.open = false; }));

  // The map: metres from the origin, or a scene's columns and lines, on a plane.
  const [west, south, east, north] = data.box, whole = [[south, west], [north, east]];
  const map = L.map("leaflet", { crs: L.CRS.Simple, preferCanvas: true, zoomSnap: 0.25, zoomDelta: 0.75, minZoom: -30,
    maxZoom: 30, scrollWheelZoom: false, wheelPxPerZoomLevel: 90 });
  map.attributionControl.setPrefix("Leaflet");
  const wide = matchMedia("(min-width: 761px)").matches;
  map.fitBounds(whole, { paddingTopLeft: [12, 12], paddingBottomRight: [wide ? 270 : 12, 12] });
  map.setMinZoom(map.getZoom() - 2).setMaxZoom(map.getZoom() + 7);
  if (data.metres) L.control.scale({ imperial: false }).addTo(map);
  map.on("focus", () => map.scrollWheelZoom.enable()).on("blur", () => map.scrollWheelZoom.disable());
  map.on("mousemove", (event) => {
    const x = data.origin[0] + event.latlng.lng, y = data.origin[1] + event.latlng.lat * (data.down ? -1 : 1);
    get("place").textContent = data.down ? `${data.axes[0]} ${x.toFixed(0)}, ${data.axes[1]} ${y.toFixed(0)}`
      : `${data.axes[0]} ${x.toFixed(1)}  ${data.axes[1]} ${y.toFixed(1)} ${data.unit}`;
  });

  const path = (flat) => Array.from({ length: flat.length / 2 }, (_, k) => [flat[2 * k + 1], flat[2 * k]]);
  const source = (uri) => (uri.startsWith("#") ? document.querySelector(uri).src : uri);
  const images = [{ name: "mosaic", title: "the mosaic", uri: "#mosaic-image", box: data.box, opacity: 1 }, ...data.images];
  const overlay = new Map(images.map((image, k) => {
    map.createPane(image.name).style.zIndex = (image.use === "layer" ? 250 : 210) + k;  // layers lie on what is compared, too
    const [w, s, e, n] = image.box;
    return [image.name, L.imageOverlay(source(image.uri), [[s, w], [n, e]], { pane: image.name, opacity: image.opacity })];
  }));

  // Surveyed points: distinguished by their symbol, blunders crossed out.
  const MARKS = { triangle: "M9 1.5 17 15.5H1Z", square: "M2.5 2.5h13v13h-13Z" }, CROSS = "M1.5 1.5l15 15M16.5 1.5l-15 15";
  function symbol(mark, colour, blunder) {
    const made = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    made.setAttribute("viewBox", "0 0 18 18");
    for (const [d, style] of [[MARKS[mark], `fill:${colour};stroke:#fff;stroke-width:1.5`],
      ...(blunder ? [[CROSS, "stroke:#fff;stroke-width:4.5"], [CROSS, "stroke:#111;stroke-width:2"]] : [])]) {
      const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
      path.setAttribute("d", d);
      path.setAttribute("style", style);
      made.append(path);
    }
    return made;
  }
  function surveyed(layer, k, at, odd) {
    const icon = L.divIcon({ className: "surveyed", html: symbol(layer.mark, layer.colour, odd), iconSize: [13, 13] });
    return L.marker(at, { icon, alt: layer.labels[k], keyboard: true });
  }

  function drawn(layer) {
    const group = L.layerGroup(), odd = new Set(layer.odd);
    if (layer.lines.length) {
      if (layer.mark) L.polyline(layer.lines.map(path), { color: "#fff", weight: layer.weight + 3, interactive: false }).addTo(group);
      L.polyline(layer.lines.map(path), { color: layer.colour, weight: layer.weight, dashArray: layer.dash || null, interactive: false }).addTo(group);
    }
    const places = layer.areas.length ? layer.areas : layer.points;
    places.forEach((place, k) => {
      if (!place.length) return;
      const row = layer.rows.length ? layer.rows[k] : undefined, colour = odd.has(k) ? ODD : layer.colour;
      const style = layer.areas.length
        ? { color: colour, weight: layer.weight, opacity: 1, fill: true, fillColor: colour, fillOpacity: layer.fill, dashArray: layer.dash || null }
        : { color: "#111", weight: 1, opacity: 1, fill: true, fillColor: colour, fillOpacity: 1, radius: layer.permanent ? 2.5 : 4.5 };
      const shape = (layer.mark ? surveyed(layer, k, path(place)[0], odd.has(k))
        : layer.areas.length ? L.polygon(path(place), style) : L.circleMarker(path(place)[0], style)).addTo(group);
      if (layer.mark) {  // to the side where there is room
        shape.on("mouseover click focus", () => {
          shape.getTooltip().options.direction = map.latLngToContainerPoint(shape.getLatLng()).x > 240 ? "left" : "right";
        });
      }
      if (layer.labels.length) {
        const words = () => element("span", { textContent: layer.labels[k] });
        shape.bindTooltip(words, layer.permanent ? { permanent: true, direction: "top", offset: [0, -2], className: "fixed" } : layer.mark ? { direction: "left" } : { sticky: true });
      }
      if (row === undefined) return;
      shape.on("click", () => choose(row, true));
      if (!shapes.has(row)) shapes.set(row, []);
      shapes.get(row).push([shape, style]);
      if (!outlines.has(row)) outlines.set(row, place.length > 2 ? path(place) : L.latLngBounds([path(place)[0]]).pad(0));
    });
    return group;
  }

  // Their legend: symbols, and an arrow of the residuals' scale.
  const marks = new Set(), legend = L.control({ position: "bottomleft" }), inside = element("div", { className: "legend" });
  legend.onAdd = () => inside;
  function explain() {
    if (!marks.size) return legend.remove();
    const shown = [...marks], { factor } = shown[0];
    const per_m = map.options.crs.scale(map.getZoom()) * factor, most = 90 / per_m, power = 10 ** Math.floor(Math.log10(most));
    const length = Math.max(...[1, 2, 5].map((m) => m * power).filter((m) => m <= most));
    const rows = shown.map((layer) => element("div", {}, symbol(layer.mark, layer.colour, false), layer.title));
    const wrong = shown.find((layer) => layer.odd.length);
    if (wrong) rows.push(element("div", {}, symbol(wrong.mark, wrong.colour, true), "Blunder"));
    const arrow = element("i", { style: `width:${(length * per_m).toFixed(1)}px` });
    const words = length < 1 ? `${+(100 * length).toPrecision(1)} cm` : `${length} m`;
    rows.push(element("div", {}, arrow, `${words}, ${factor === 1 ? "true to scale" : `drawn ${factor.toLocaleString("en")} times larger`}`));
    inside.replaceChildren(...rows);
    legend.addTo(map);
  }
  map.on("zoomend", () => marks.size && explain());

  // Switches.
  const list = get("layers").querySelector("div"), notes = new Map();
  function say() {
    const titles = new Map();
    for (const [title, note] of notes) titles.set(note, [...(titles.get(note) || []), title]);
    get("notes").textContent = [...titles].map(([note, of]) => `${of.join(", ")}: ${note}`).join(". ");
  }
  function toggle(entry, layer, colour) {
    const box = element("input", { type: "checkbox", checked: entry.shown });
    box.dataset.layer = entry.name;
    const set = () => {
      box.checked ? layer.addTo(map) : layer.remove();
      box.checked && entry.note ? notes.set(entry.title, entry.note) : notes.delete(entry.title);
      say();
      if (entry.mark) { box.checked ? marks.add(entry) : marks.delete(entry); explain(); }
    };
    box.addEventListener("change", set);
    set();
    const label = element("label", {}, box, element("span", { textContent: entry.title }));
    if (entry.mark) label.append(symbol(entry.mark, colour, false));
    else if (colour) label.append(Object.assign(element("i"), { style: `background:${colour}` }));
    list.append(label);
  }
  toggle({ name: "mosaic", title: "Mosaic", shown: true }, overlay.get("mosaic"));
  const fade = element("input", { type: "range", min: 0, max: 1, step: 0.05, value: 1 });
  fade.setAttribute("aria-label", "opacity of the mosaic");
  fade.addEventListener("input", () => overlay.get("mosaic").setOpacity(fade.value));
  list.append(fade);
  data.images.filter((image) => image.use === "layer").forEach((image) => toggle(image, overlay.get(image.name)));
  list.append(element("hr"));
  data.layers.forEach((layer) => toggle(layer, drawn(layer), layer.colour));
  get("layers").open = wide;

  // The swipe: two images, a border between them.
  const compared = data.images.filter((image) => image.use === "compare");
  const handle = get("swipe"), left = get("left"), right = get("right");
  let share = 0.5;
  function clip() {
    const on = compared.length > 0 && left.value !== right.value, size = map.getSize();
    handle.hidden = !on;
    handle.style.left = `${100 * share}%`;
    handle.setAttribute("aria-valuenow", String(Math.round(100 * share)));
    const from = map.containerPointToLayerPoint([0, 0]), to = map.containerPointToLayerPoint(size), at = from.x + share * size.x;
    for (const image of [images[0], ...compared]) {
      const pane = map.getPane(image.name), sides = on && [left.value, right.value].indexOf(image.name);
      pane.style.clip = !on ? "auto" : sides === 0 ? `rect(${from.y}px,${at}px,${to.y}px,${from.x}px)` : `rect(${from.y}px,${to.x}px,${to.y}px,${at}px)`;
      if (image.name === "mosaic") pane.style.display = on && sides < 0 ? "none" : "";
      else (on && sides >= 0) || (!on && left.value === image.name) ? overlay.get(image.name).addTo(map) : overlay.get(image.name).remove();
    }
  }
  if (compared.length) {
    get("sides").hidden = false;
    for (const side of [left, right]) {
      for (const image of [...compared, images[0]]) side.add(new Option(image.name === "mosaic" ? "adjusted" : image.title, image.name));
      side.value = "mosaic";
      side.addEventListener("change", clip);
    }
    const move = (x) => {
      const box = map.getContainer().getBoundingClientRect();
      share = Math.min(Math.max((x - box.left) / box.width, 0), 1);
      clip();
    };
    handle.addEventListener("pointerdown", (event) => {
      handle.setPointerCapture(event.pointerId);
      handle.onpointermove = (e) => move(e.clientX);
    });
    handle.addEventListener("pointerup", () => { handle.onpointermove = null; });
    handle.addEventListener("keydown", (event) => {
      const by = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
      if (by) { share = Math.min(Math.max(share + by, 0), 1); clip(); event.preventDefault(); }
    });
    map.on("move zoomend resize viewreset", clip);
    clip();
  }

  // The table: sorted, filtered, and one row chosen there or on the map.
  const body = get("rows").tBodies[0], heads = [...get("rows").tHead.rows[0].cells];
  heads.forEach((head, column) => head.firstElementChild.addEventListener("click", () => {
    const down = head.getAttribute("aria-sort") === "ascending", numbers = head.classList.contains("n");
    const key = (row) => { const cell = row.cells[column]; return numbers ? Number(cell.dataset.by) : cell.textContent; };
    const keyed = rows.map((row) => [key(row), row]);
    keyed.sort(([a], [b]) => (numbers ? a - b : a.localeCompare(b, undefined, { numeric: true })) * (down ? -1 : 1));
    heads.forEach((h) => h.removeAttribute("aria-sort"));
    head.setAttribute("aria-sort", down ? "descending" : "ascending");
    body.append(...keyed.map(([, row]) => row));
  }));

  const words = new Map(rows.map((row) => [row, row.textContent.toLowerCase()]));
  function filter() {
    const wanted = get("filter").value.toLowerCase().split(/\s+/).filter(Boolean), kind = get("kind") ? get("kind").value : "";
    let shown = 0;
    for (const row of rows) {
      const fits = (!kind || row.dataset.kind === kind) && wanted.every((word) => words.get(row).includes(word));
      row.hidden = !fits;
      shown += fits;
      for (const [shape, style] of shapes.get(Number(row.dataset.row)) || []) {
        shape.setStyle({ opacity: fits ? style.opacity : FADED, fillOpacity: fits ? style.fillOpacity : style.fillOpacity * FADED });
      }
    }
    get("shown").textContent = shown === rows.length ? all : `${shown} of ${all}`;
  }
  const all = get("shown").textContent;
  get("filter").addEventListener("input", filter);
  if (get("kind")) get("kind").addEventListener("change", filter);
  get("filters").addEventListener("submit", (event) => event.preventDefault());

  const marked = L.layerGroup().addTo(map);
  let chosen = null;
  function choose(number, onMap) {
    if (chosen) chosen.removeAttribute("aria-selected");
    marked.clearLayers();
    chosen = number === null ? null : rowOf.get(number) || null;
    if (number === null) return;
    if (chosen) {
      chosen.setAttribute("aria-selected", "true");
      if (onMap) {
        const box = body.parentElement.parentElement;
        box.scrollTop = chosen.offsetTop - box.clientHeight / 2;
      }
    }
    const outline = outlines.get(number);
    if (!outline) return;
    for (const style of [{ color: "#fff", weight: 6 }, { color: CHOSEN, weight: 3 }]) {
      L.polygon(outline instanceof L.LatLngBounds ? [outline.getCenter()] : outline, { ...style, fill: false, interactive: false }).addTo(marked);
    }
    const bounds = outline instanceof L.LatLngBounds ? outline : L.latLngBounds(outline);
    if (!onMap && !map.getBounds().contains(bounds)) {
      if (map.getBoundsZoom(bounds) < map.getZoom()) map.fitBounds(bounds, { padding: [20, 20] });
      else map.panTo(bounds.getCenter());
    }
  }
  const pick = (event) => {
    const row = event.target.closest("tr");
    if (row) choose(row === chosen ? null : Number(row.dataset.row), false);
  };
  body.addEventListener("click", pick);
  body.addEventListener("keydown", (event) => {
    const row = event.target.closest("tr"), step = { ArrowDown: "nextElementSibling", ArrowUp: "previousElementSibling" }[event.key];
    if (event.key === "Enter" || event.key === " ") pick(event);
    else if (step && row) {
      let next = row[step];
      while (next && next.hidden) next = next[step];
      if (next) { next.focus(); choose(Number(next.dataset.row), false); }
    } else return;
    event.preventDefault();
  });
  document.addEventListener("keydown", (event) => { if (event.key === "Escape") choose(null); });
})();
