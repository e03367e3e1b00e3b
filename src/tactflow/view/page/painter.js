// The worker behind the page: talks to the run, and draws its frames and plots.
//
// A canvas that belongs to a worker reaches the screen without the page: no style, layout or paint for a new
// frame. The page itself hears a summary of the frames, a few times a second.

import { Connection } from "./connection.js";
import { Picture } from "./picture.js";
import { Plot, SECONDS } from "./plot.js";

const BUSY_MS = 20;  // a frame that took longer is followed by a rest: the machine is full
const NEWS_MS = 200;  // between two changes of anything but the picture

let connection = null;
let picture = null;
let plots = [];
let run = null;
let current = null;
let visible = Promise.resolve();
let reveal = null;  // ends the wait of a hidden page
let hiddenSince = 0;
const sensors = new Map();

const tell = (type, content = {}) => postMessage({ type, ...content });

function sensor(name) {
  if (!sensors.has(name)) {
    sensors.set(name, { name, points: [], header: null, bitmap: null, shown: [], told: -Infinity, timer: 0 });
    current ??= name;
  }
  return sensors.get(name);
}

// -- from the page ----------------------------------------------------------------------------------------

const orders = {
  begin({ canvases, token, hidden }) {
    const degrees = (value) => `${value}°`.replace("-", "−");
    picture = new Picture(canvases.picture);
    plots = [
      new Plot(canvases["plot-area"], { series: [(p) => p.area], range: "positive", minimum: 100 }),
      new Plot(canvases["plot-angle"], { series: [(p) => p.angle], range: [-90, 90], jump: 90, format: degrees }),
      new Plot(canvases["plot-flow"], { series: [(p) => p.dx, (p) => p.dy], range: "symmetric", minimum: 1 }),
      new Plot(canvases["plot-latency"], { series: [(p) => p.latency], range: "positive", minimum: 4 }),
    ];
    orders.hide({ hidden });
    connection = new Connection(token, { open: () => tell("open"), text, frame, lost: (seconds) => tell("lost", { seconds }), refused: () => tell("refused") });
  },
  resize({ index, width, height, ratio }) {
    [picture, ...plots][index].resize(width, height, ratio);
  },
  colours({ colours }) {
    for (const drawing of [picture, ...plots]) drawing.recolour(colours);
  },
  layers({ layers, magnify }) {
    picture.choose(layers, magnify);
  },
  choose({ name }) {
    current = name;
    const s = sensor(name);
    picture.show(s.bitmap, s.header);
    replot();
  },
  hide({ hidden }) {
    if (hidden && reveal === null) {
      hiddenSince = performance.now();
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
    // Another run behind the same address: what is on the screen is not its own.
    if (run !== null && run !== message.run) {
      picture.show(null, null);
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

async function frame(header, blob) {
  const received = performance.now();
  const s = sensor(header.message.sensor);
  let bitmap = null;
  try {
    bitmap = await createImageBitmap(blob);
  } catch {
    tell("note", { text: "a picture could not be decoded" });
  }
  // A hidden page draws nothing, and is sent nothing, until it is looked at again.
  await visible;
  if (bitmap) {
    s.bitmap?.close();
    s.bitmap = bitmap;
  }
  addFrame(s, header);
  // The run sends the next frame only now: a slow page gets fewer of them, never old ones.
  const busy = performance.now() - received;
  const late = hiddenSince > received;
  connection.send({ ack: header.number, late, rest: late || busy < BUSY_MS ? 0 : Math.round(busy) });
}

function addFrame(s, header) {
  const message = header.message;
  const flow = message.flow?.mean ?? null;
  const last = s.points[s.points.length - 1];
  if (last && message.t < last.t) s.points.length = 0;
  s.points.push({
    t: message.t,
    area: message.contact?.area ?? null,
    angle: message.contact?.angle ?? null,
    dx: flow && flow[0],
    dy: flow && flow[1],
    latency: header.latency_ms < 0 ? null : header.latency_ms,
  });
  const first = s.points.findIndex((point) => point.t >= message.t - SECONDS);
  if (first > 0) s.points.splice(0, first);
  if (s.header && header.epoch !== s.header.epoch) tell("note", { text: `new reference taken at frame ${message.seq}` });
  s.header = header;
  const now = performance.now();
  s.shown.push(now);
  while (now - s.shown[0] > 1000) s.shown.shift();
  if (s.name === current) picture.show(s.bitmap, header);
  if (now - s.told >= NEWS_MS) summarise(s);
  else if (!s.timer) s.timer = setTimeout(summarise, s.told + NEWS_MS - now, s);
}

// The plots, and what the page writes in words.
function summarise(s) {
  if (s.name === current) replot();
  clearTimeout(s.timer);
  s.timer = 0;
  s.told = performance.now();
  const { message: { seq, t, size, contact, flow }, markers, latency_ms } = s.header;
  const count = (letter) => markers.status.split(letter).length - 1;
  tell("frames", {
    sensor: s.name,
    summary: {
      seq, t,
      counts: markers && { tracked: count("t"), inferred: count("i"), lost: count("l") },
      aspect: size[0] / size[1],
      contact: contact && { area: contact.area, angle: contact.angle, confidence: contact.confidence },
      flow: flow && { mean: flow.mean, count: flow.count, rotation: flow.rotation },
      latency: latency_ms,
      shown: s.shown.length,
      points: s.points.length,
    },
  });
}

function replot() {
  const points = sensors.get(current)?.points ?? [];
  for (const plot of plots) plot.draw(points);
}
