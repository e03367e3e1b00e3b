// The worker of the page: receives frames from the run, and draws them and the plots.
//
// A canvas owned by a worker is displayed without style, layout or paint by the page. The page only receives a summary
// of the frames, a few times per second.

import { Connection } from "./connection.js";
import { Picture } from "./picture.js";
import { Plot, SECONDS } from "./plot.js";
import { Surface } from "./surface.js";

const NEWS_MS = 200;  // interval between updates of all but the picture

let connection = null;
let picture = null;
let surface = null;
let plots = {};
let showsSurface = false;
let run = null;
let current = null;
let visible = Promise.resolve();
let reveal = null;  // resolves `visible`
const sensors = new Map();

const tell = (type, content = {}) => postMessage({ type, ...content });

function sensor(name) {
  if (!sensors.has(name)) {
    sensors.set(name, { name, points: [], header: null, bitmap: null, heights: null, offers: new Set(), shown: [], summarised: -Infinity, timer: 0 });
    current ??= name;
  }
  return sensors.get(name);
}

// -- from the page ----------------------------------------------------------------------------------------

const orders = {
  begin({ canvases, token, hidden }) {
    const degrees = (value) => `${value}°`.replace("-", "−");
    const plot = (id, options) => [id, new Plot(canvases[id], options)];
    picture = new Picture(canvases.picture);
    surface = new Surface(canvases.surface);
    plots = Object.fromEntries([
      plot("plot-area", { series: [(p, unit) => p.area[unit]], range: "positive", minimum: { px: 100, mm: 0.1 } }),
      plot("plot-angle", { series: [(p) => p.angle], range: [-90, 90], jump: 90, format: degrees }),
      plot("plot-flow", { series: [0, 1].map((axis) => (p, unit) => p.flow[unit][axis]), range: "symmetric", minimum: { px: 1, mm: 0.1 } }),
      plot("plot-latency", { series: [(p) => p.latency], range: "positive", minimum: 4 }),
      plot("plot-depth", { series: [(p) => p.depth], range: "positive", minimum: 0.1 }),
      plot("plot-force", { series: [0, 1, 2].map((axis) => (p) => p.force[axis]), range: "signed", minimum: 0.1 }),
      plot("plot-slip", { series: [(p) => p.stick], range: [0, 1] }),
      plot("plot-pose", { series: [0, 1, 2].map((axis) => (p) => p.pose[axis]), range: "signed", minimum: 0.1 }),
    ]);
    tell("turns", { turns: surface.turns });
    orders.hide({ hidden });
    connection = new Connection(token, { open: () => tell("open"), text, frame, lost: (seconds) => tell("lost", { seconds }), refused: () => tell("refused") });
  },
  resize({ id, width, height, ratio }) {
    ({ picture, surface, ...plots })[id].resize(width, height, ratio);
  },
  colours({ colours }) {
    for (const drawing of [picture, surface, ...Object.values(plots)]) drawing.recolour(colours);
  },
  layers({ layers, magnify, rise, unit }) {
    picture.choose(layers, magnify, unit);
    surface.choose(rise);
    for (const plot of Object.values(plots)) plot.choose(unit);
    showsSurface = layers.surface;
    if (current !== null) showSurface(sensor(current));
  },
  turn({ dx, dy }) {
    surface.turn(dx, dy);
  },
  choose({ name }) {
    current = name;
    showFrame(sensor(name));
    replot();
  },
  hide({ hidden }) {
    if (hidden && reveal === null) {
      visible = new Promise((resolve) => { reveal = resolve; });
    } else if (!hidden && reveal !== null) {
      reveal();
      reveal = null;
      connection?.retryNow();
    }
  },
  send: ({ message }) => connection.send(message),
  retry: () => connection.retryNow(),
  token: ({ token }) => connection.useToken(token),
};
onmessage = ({ data }) => orders[data.order](data);

// -- from the run -----------------------------------------------------------------------------------------

function text(message) {
  if (message.type === "hello") {
    // A new run at the same address: discard the state of the previous one.
    if (run !== null && run !== message.run) {
      picture.show(null, null);
      surface.show(null, null, 1);
      for (const { timer, bitmap } of sensors.values()) {
        clearTimeout(timer);
        bitmap?.close();
      }
      sensors.clear();
      current = null;
    }
    run = message.run;
    message.sensors.forEach(sensor);
    replot();
  }
  tell(message.type, { message });
}

async function frame(header, blob, heights) {
  const s = sensor(header.message.sensor);
  let bitmap = null;
  try {
    bitmap = await createImageBitmap(blob);
  } catch {
    tell("note", { text: "a picture could not be decoded" });
  }
  // A hidden page neither draws nor requests frames.
  await visible;
  if (bitmap) {
    s.bitmap?.close();
    s.bitmap = bitmap;
  }
  addFrame(s, header, heights);
  // The run sends the next frame after this: a slow page gets fewer frames instead of old ones.
  connection.send({ ack: header.number });
}

function addFrame(s, header, heights) {
  const { message } = header;
  const { contact, flow, force, slip, pose } = message;
  const last = s.points[s.points.length - 1];
  if (last && message.t < last.t) s.points.length = 0;
  s.points.push({
    t: message.t,
    area: { px: contact?.area ?? null, mm: contact?.area_mm2 ?? null },
    angle: contact?.angle ?? null,
    flow: { px: flow?.mean ?? [null, null], mm: flow?.mean_mm ?? [null, null] },
    latency: header.latency_ms < 0 ? null : header.latency_ms,
    depth: contact?.depth_mm ?? null,
    force: force?.value ?? [null, null, null],
    stick: slip?.stick_ratio ?? null,
    pose: pose?.translation ?? [null, null, null],
  });
  const first = s.points.findIndex((point) => point.t >= message.t - SECONDS);
  if (first > 0) s.points.splice(0, first);
  if (s.header && header.epoch !== s.header.epoch) tell("note", { text: `new reference taken at frame ${message.seq}` });
  const available = { scale: header.scale, field: header.field, surface: header.surface, guide: header.guide, force, slip, pose };
  for (const [name, value] of Object.entries(available)) if (value) s.offers.add(name);
  Object.assign(s, { header, heights });
  const now = performance.now();
  s.shown.push(now);
  while (now - s.shown[0] > 1000) s.shown.shift();
  if (s.name === current) showFrame(s);
  if (now - s.summarised >= NEWS_MS) summarise(s);
  else if (!s.timer) s.timer = setTimeout(summarise, s.summarised + NEWS_MS - now, s);
}

function showFrame(s) {
  picture.show(s.bitmap, s.header);
  showSurface(s);
}

function showSurface(s) {
  // The colour scale is that of the plot, which rarely changes.
  if (showsSurface) surface.show(s.header, s.heights, plots["plot-depth"].limits(s.points)[1]);
}

// Update the plots and the text of the page.
function summarise(s) {
  if (s.name === current) replot();
  clearTimeout(s.timer);
  s.timer = 0;
  s.summarised = performance.now();
  const { message: { seq, t, size, contact, flow, force, slip, pose }, markers, latency_ms, guide } = s.header;
  const count = (letter) => markers.status.split(letter).length - 1;
  tell("frames", {
    sensor: s.name,
    summary: {
      seq, t, flow, force, slip, pose, guide,
      counts: markers && { tracked: count("t"), inferred: count("i"), lost: count("l") },
      aspect: size[0] / size[1],
      contact: contact && { ...contact, hull: undefined },
      offers: [...s.offers],
      deepest: plots["plot-depth"].limits(s.points)[1],
      latency: latency_ms,
      shown: s.shown.length,
      points: s.points.length,
    },
  });
}

function replot() {
  const points = sensors.get(current)?.points ?? [];
  for (const plot of Object.values(plots)) plot.draw(points);
}
