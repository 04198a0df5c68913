// Opens a recording in the last open build of Foxglove's app, in Chromium, goes to its end, takes a picture.
// node foxglove_studio.mjs RUN.mcap [PICTURE.png]; MCAP_MODULES or node_modules beside holds
// @foxglove/studio-base@1.48.0 react@17.0.2 react-dom@17.0.2 puppeteer-core. Prints JSON: what the app lists of
// topics, its problems, errors of the page, and which hosts it asked besides this one.
import { createReadStream, existsSync, statSync } from "node:fs";
import { createServer } from "node:http";
import { createRequire } from "node:module";
import { dirname, extname, join } from "node:path";

const [recording, picture] = process.argv.slice(2);
const require = createRequire(process.env.MCAP_MODULES ?? import.meta.url);
const puppeteer = require("puppeteer-core");
const folderOf = (name) => dirname(require.resolve(`${name}/package.json`));
const [studio, react, dom] = ["@foxglove/studio-base", "react", "react-dom"].map(folderOf);
const chromium = process.env.CHROMIUM ?? "/usr/bin/chromium";

const image = { enabledMarkerTopics: [], synchronize: false, mode: "fit", transformMarkers: false };
const step = (field) => ({ value: `"/iterations/adjustment.solve".${field}`, enabled: true, timestampMethod: "receiveTime" });
const side = (direction, first, second) => ({ direction, first, second });
const layout = {
  configById: {
    "map!1": { layer: "custom", customTileUrl: "", disabledTopics: [], followTopic: "/location/tied", zoomLevel: 16.6, topicColors: { "/footprints/placed": "#888888", "/location/placed": "#ffffff" } },
    "ImageViewPanel!1": { ...image, cameraTopic: "/images/mosaic" },
    "3D!1": {
      followTf: "map", followMode: "follow-pose", imageMode: {}, layers: {}, publish: {}, transforms: {},
      scene: { transforms: { axisScale: 12, showLabel: false, lineWidth: 0, editable: false } },
      cameraState: { perspective: true, distance: 210, phi: 52, thetaOffset: 25, target: [0, 0, 0], targetOffset: [0, 0, 0], targetOrientation: [0, 0, 0, 1], fovy: 45, near: 0.5, far: 5000 },
      topics: {
        "/points/ties": { visible: true, pointSize: 4, colorMode: "colormap", colorMap: "turbo", colorField: "z" },
        "/path": { visible: true, type: "line", gradient: ["#ffffffff", "#ffffffff"], lineWidth: 0.4 },
      },
    },
    "Plot!1": {
      paths: [step("sigma_px"), step("step_m")], xAxisVal: "custom", xAxisPath: step("iteration"), isSynced: false,
      showXAxisLabels: true, showYAxisLabels: true, showLegend: true, legendDisplay: "floating", sidebarDimension: 240,
    },
    "RosOut!1": { searchTerms: [], minLogLevel: 1 },
    "RawMessages!1": { topicPath: '"/tables/frames.adjusted"', diffMethod: "custom", diffTopicPath: "" },
  },
  layout: side(
    "column",
    side("row", "map!1", side("row", "3D!1", "ImageViewPanel!1")),
    side("row", "Plot!1", side("row", "RosOut!1", "RawMessages!1")),
  ),
  globalVariables: {}, userNodes: {}, playbackConfig: { speed: 1 },
};
const page = `<!doctype html><meta charset="utf-8"><style>html,body,#root{height:100%;margin:0}</style><div id="root"></div>
<script src="/react.js"></script><script>react = React</script><script src="/react-dom.js"></script>
<script>window["react-dom"] = ReactDOM; global = window; process = { env: {} };</script>
<script src="/assets/index.js"></script><script>
const settings = new Map([["colorScheme", "dark"], ["telemetry.telemetryEnabled", false], ["telemetry.crashReportingEnabled", false]]);
const appConfiguration = { get: (k) => settings.get(k), set: async (k, v) => settings.set(k, v), addChangeListener() {}, removeChangeListener() {} };
const kept = new Map([["run", { id: "run", name: "run", permission: "CREATOR_WRITE", baseline: { data: ${JSON.stringify(layout)}, savedAt: new Date().toISOString() } }]]);
const layoutStorage = { list: async () => [...kept.values()], get: async (_, id) => kept.get(id), put: async (_, l) => (kept.set(l.id, l), l), delete: async (_, id) => kept.delete(id), importLayouts: async () => {} };
initI18n().then(() => ReactDOM.render(React.createElement(App, { deepLinks: [location.href], appConfiguration, layoutStorage, dataSources: [new RemoteDataSourceFactory()], extensionLoaders: [], enableGlobalCss: true }), root));
</script>`;
const files = {
  "/react.js": join(react, "umd/react.production.min.js"),
  "/react-dom.js": join(dom, "umd/react-dom.production.min.js"),
  "/run.mcap": recording,
};
const kinds = { ".js": "text/javascript", ".wasm": "application/wasm", ".svg": "image/svg+xml", ".png": "image/png" };

const server = createServer((request, response) => {
  const path = new URL(request.url, "http://x").pathname;
  const file = files[path] ?? (path.startsWith("/assets/") ? join(studio, path) : "");
  if (path === "/") return response.setHeader("content-type", "text/html").end(page);
  if (!file || !existsSync(file)) return response.writeHead(path === "/favicon.ico" ? 204 : 404).end();
  const bytes = statSync(file).size;
  const asked = /bytes=(\d+)-(\d*)/.exec(request.headers.range ?? "");
  const [start, last] = asked ? [Number(asked[1]), Math.min(Number(asked[2] || bytes), bytes - 1)] : [0, bytes - 1];
  response.writeHead(asked ? 206 : 200, {
    "accept-ranges": "bytes", "content-length": last - start + 1, "content-range": `bytes ${start}-${last}/${bytes}`,
    "content-type": kinds[extname(file)] ?? "application/octet-stream",
  });
  if (request.method === "HEAD") return response.end();
  createReadStream(file, { start, end: last }).pipe(response);
}).listen(0, "127.0.0.1", async () => {
  const here = `http://127.0.0.1:${server.address().port}`;
  const browser = await puppeteer.launch({
    executablePath: chromium, headless: true, args: ["--no-sandbox", "--enable-unsafe-swiftshader"], defaultViewport: { width: 1900, height: 1060 },
  });
  try {
    const tab = await browser.newPage();
    const [errors, asked] = [[], new Set()];
    tab.on("pageerror", (error) => errors.push(String(error)));
    tab.on("console", (line) => line.type() === "error" && errors.push(line.text()));
    tab.on("request", (r) => r.url().startsWith("http") && !r.url().startsWith(here) && asked.add(new URL(r.url()).hostname));
    await tab.goto(`${here}/?ds=remote-file&ds.url=${encodeURIComponent(`${here}/run.mcap`)}&layoutId=run`);
    const pause = (ms) => new Promise((done) => setTimeout(done, ms));
    const text = () => tab.evaluate(() => document.body.innerText);
    await tab.waitForFunction(() => document.body.innerText.includes("\n/stages"), { timeout: 120000 });
    const topics = Object.fromEntries([...(await text()).matchAll(/^(\/\S+)\n(\S+)\n(\d+)$/gm)].map(([, name, , count]) => [name, Number(count)]));
    await pause(5000);
    await tab.mouse.click(1885, 1003); // the end of the time line
    await pause(15000);
    if (picture) await tab.screenshot({ path: picture });
    await tab.evaluate(() => [...document.querySelectorAll("button")].find((b) => b.innerText.startsWith("Problems"))?.click());
    await pause(2000);
    const problems = (await text()).includes("No problems found") ? [] : [await text()];
    console.log(JSON.stringify({ topics, problems, errors, asked: [...asked] }));
  } finally {
    await browser.close();
    server.close();
  }
});
