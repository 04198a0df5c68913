// Measures in words and as a plot. A value that is unknown is null.

export const KINDS = [
  { name: "place", title: "Place", key: "p", least: 1, most: 1 },
  { name: "distance", title: "Distance", key: "d", least: 2 },
  { name: "profile", title: "Profile", key: "r", least: 2 },
  { name: "area", title: "Area", key: "a", least: 3, closed: true },
  { name: "volume", title: "Volume", key: "v", least: 3, closed: true },
];

const BALANCE = "Above less below";

// A value with as many digits as two of its deviation.
export function withDeviation(value, sd, unit) {
  if (value === null || value === undefined) return "unknown";
  const digits = sd ? Math.min(Math.max(1 - Math.floor(Math.log10(sd)), 0), 4) : 2;
  const words = v => v.toLocaleString("en", { minimumFractionDigits: digits, maximumFractionDigits: digits });
  return sd === null || sd === undefined ? `${words(value)} ${unit}, deviation unknown` : `${words(value)} ± ${words(sd)} ${unit}`;
}

const number = (value, digits) => value.toFixed(digits);

// Pairs of label and value.
export function lines(kind, found, flat) {
  if (found.error) return [["", found.error]];
  const figure = (of, unit) => withDeviation(of.value, of.sd, unit);
  const rows = [];
  if (kind === "place") {
    rows.push(["East", withDeviation(found.east, found.plan_sd, "m")], ["North", withDeviation(found.north, found.plan_sd, "m")]);
    if ("height" in found) rows.push(["Height", withDeviation(found.height, found.height_sd, "m")]);
    if ("lat" in found) rows.push(["Latitude", `${number(found.lat, 8)}°`], ["Longitude", `${number(found.lon, 8)}°`]);
  } else if (kind === "distance" || kind === "profile") {
    rows.push(["Length", figure(found.length, "m")]);
    if (found.length.ellipsoidal !== null) rows.push(["On the ellipsoid", `${number(found.length.ellipsoidal, 3)} m`]);
    if (found.rise) rows.push(["Height difference", figure(found.rise, "m")]);
    const known = found.profile?.height.filter(h => h !== null) ?? [];
    if (known.length) rows.push(["Lowest, highest", `${number(Math.min(...known), 2)}, ${number(Math.max(...known), 2)} m`]);
  } else {
    rows.push(["Area", figure(found.area, "m²")]);
    if (found.area.ellipsoidal !== null) rows.push(["On the ellipsoid", `${number(found.area.ellipsoidal, 3)} m²`]);
    if (kind === "volume" && found.volume) {
      const { above, below, sd } = found.volume;
      rows.push(["Above the rim", withDeviation(above, sd, "m³")], ["Below the rim", withDeviation(below, sd, "m³")], [BALANCE, withDeviation(above - below, sd, "m³")]);
    } else if (kind === "volume") rows.push(["Volume", found.surface ? "unknown: the surface has gaps there" : "unknown: the run has no surface"]);
  }
  return rows;
}

// The value that is shown while points are still being added.
export function headline(kind, found) {
  const rows = lines(kind, found), [, words] = rows.find(([label]) => label === BALANCE) ?? rows[0];
  return words;
}

const SVG = "http://www.w3.org/2000/svg";
function drawn(name, attributes, words) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  if (words !== undefined) made.textContent = words;
  return made;
}

// Heights along a line with one deviation about them; gaps where they are unknown.
export function profilePlot({ along, height, sd }) {
  const [WIDTH, HEIGHT, LEFT, BOTTOM, TOP] = [292, 130, 38, 18, 6];
  const plot = drawn("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": "Heights along the line" });
  const known = height.flatMap((h, k) => (h === null ? [] : [h - (sd[k] ?? 0), h + (sd[k] ?? 0)]));
  if (!known.length) return plot;
  const low = Math.min(...known), high = Math.max(Math.max(...known), low + 0.1), length = along.at(-1) || 1;
  const x = m => LEFT + (WIDTH - LEFT - 4) * m / length, y = h => TOP + (HEIGHT - TOP - BOTTOM) * (high - h) / (high - low);
  for (const h of [low, (low + high) / 2, high]) {
    plot.append(drawn("line", { class: "rule", x1: LEFT, x2: WIDTH - 4, y1: y(h), y2: y(h) }), drawn("text", { x: LEFT - 4, y: y(h) + 3, "text-anchor": "end" }, h.toFixed(high - low < 20 ? 1 : 0)));
  }
  for (const m of [0, length / 2, length]) plot.append(drawn("text", { x: x(m), y: HEIGHT - 4, "text-anchor": m === 0 ? "start" : m === length ? "end" : "middle" }, `${m.toFixed(length < 20 ? 1 : 0)} m`));
  const runs = [];
  height.forEach((h, k) => (h === null ? runs.push([]) : (runs.at(-1) ?? runs[runs.push([]) - 1]).push(k)));
  for (const run of runs.filter(of => of.length > 1)) {
    const edge = sign => run.map(k => `${x(along[k]).toFixed(1)},${y(height[k] + sign * (sd[k] ?? 0)).toFixed(1)}`);
    plot.append(drawn("polygon", { class: "sd", points: [...edge(1), ...edge(-1).reverse()].join(" ") }), drawn("polyline", { class: "height", points: edge(0).join(" ") }));
  }
  return plot;
}
