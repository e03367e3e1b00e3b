// The page: one tab per sensor, its picture, plots and statistics, and the buttons that steer the run.

import { Connection } from "./connection.js";
import { LAYERS, Picture } from "./picture.js";
import { Plot, SECONDS, onPaletteChange } from "./plot.js";

const $ = (id) => document.getElementById(id);
const MINUS = "−";
const STALL_SECONDS = 2;
const PLOT_MS = 80;
const MAGNIFICATIONS = [1, 3, 5, 10];

const picture = new Picture($("picture"));
const plots = [
  new Plot($("plot-area"), { series: [(p) => p.area], range: "positive", minimum: 100 }),
  new Plot($("plot-angle"), { series: [(p) => p.angle], range: [-90, 90], jump: 90, format: (v) => `${v}°`.replace("-", MINUS) }),
  new Plot($("plot-flow"), { series: [(p) => p.dx, (p) => p.dy], range: "symmetric", minimum: 1 }),
  new Plot($("plot-latency"), { series: [(p) => p.latency], range: "positive", minimum: 4 }),
];
const sensors = new Map();
let current = null;
let run = null;
let link = "connecting";  // connecting, open, lost, token
let nextAttempt = 0;
let lastFrame = 0;
let hiddenSince = 0;

function sensor(name) {
  if (!sensors.has(name)) {
    sensors.set(name, { name, points: [], message: null, bitmap: null, header: null, state: null, stats: null, rate: null, shown: [], epoch: null });
    current ??= name;
    drawTabs();
  }
  return sensors.get(name);
}

// -- what comes from the run ------------------------------------------------------------------------------

const connection = new Connection({
  open() {
    link = "open";
    lastFrame = performance.now();
    refresh();
  },
  hello(message) {
    // Another run behind the same address: what is on the screen is not its own.
    if (run !== null && run !== message.run) {
      sensors.clear();
      current = null;
      picture.show(null, null);
    }
    run = message.run;
    message.sensors.forEach(sensor);
    schedule();
    refresh();
  },
  state(message) {
    const s = sensor(message.sensor);
    const changed = JSON.stringify(message.neighbours) !== JSON.stringify(s.state?.neighbours);
    s.state = message;
    if (changed) drawTabs();
    refresh();
  },
  stats(message) {
    const s = sensor(message.sensor);
    const stats = message.run;
    if (!stats.stages) return;
    if (s.stats && stats.wall_s > s.stats.wall_s) {
      s.rate = Math.max(0, stats.frames - s.stats.frames) / (stats.wall_s - s.stats.wall_s);
    }
    s.stats = stats;
    s.screen = message.screen_ms;
    if (s.name === current) drawStats(s);
    refresh();
  },
  note: (message) => note(message.text),
  frame: showFrame,
  lost(seconds) {
    link = "lost";
    nextAttempt = performance.now() + seconds * 1000;
    refresh();
  },
  refused() {
    link = "token";
    refresh();
    $("token").focus();
  },
});

async function showFrame(header, blob) {
  const received = performance.now();
  const s = sensor(header.message.sensor);
  try {
    const bitmap = await createImageBitmap(blob);
    s.bitmap?.close();
    s.bitmap = bitmap;
  } catch {
    note("a picture could not be decoded");
  }
  requestAnimationFrame(() => {
    addFrame(s, header);
    // The run sends the next frame only now: a slow page gets fewer of them, never old ones.
    connection.send({ ack: header.number, late: hiddenSince > received || document.hidden });
  });
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
  if (s.epoch !== null && header.epoch !== s.epoch) note(`new reference taken at frame ${message.seq}`);
  s.epoch = header.epoch;
  s.header = header;
  s.message = message;
  lastFrame = performance.now();
  s.shown.push(lastFrame);
  while (lastFrame - s.shown[0] > 1000) s.shown.shift();
  if (s.name === current) {
    const aspect = message.size[0] / message.size[1];
    if (s.aspect !== aspect) {
      s.aspect = aspect;
      document.documentElement.style.setProperty("--aspect", aspect.toFixed(4));
    }
    picture.show(s.bitmap, message);
    $("picture").dataset.seq = message.seq;
    schedule();
  }
  if (shownStatus !== status()) refresh();
}

// -- drawing ----------------------------------------------------------------------------------------------

let planned = 0;
let lastPlot = 0;

// Plots and numbers need not change at every frame.
function schedule() {
  if (planned) return;
  planned = setTimeout(() => {
    planned = 0;
    lastPlot = performance.now();
    const s = sensors.get(current);
    plots.forEach((plot) => plot.draw(s?.points ?? []));
    drawValues(s);
  }, Math.max(0, PLOT_MS - (performance.now() - lastPlot)));
}

function drawValues(s) {
  const message = s?.message;
  const contact = message?.contact;
  const flow = message?.flow;
  set("value-area", contact ? grouped(contact.area) : "–");
  set("unit-area", contact ? "px²" : message ? "no contact" : "");
  set("value-angle", contact && contact.angle !== null ? `${fixed(contact.angle, 1)}°` : "–");
  set("unit-angle", !contact ? "" : contact.angle === null ? "no direction" : `confidence ${fixed(contact.confidence, 2)}`);
  set("value-flow", flow?.mean ? fixed(Math.hypot(...flow.mean), 2) : "–");
  const twist = flow?.rotation == null ? "" : `, twist ${fixed(flow.rotation, 1)}°`;
  set("unit-flow", flow?.mean ? `px, ${flow.count} ${flow.count === 1 ? "marker" : "markers"}${twist}` : flow ? "no marker inside" : "");
  const latency = s?.header?.latency_ms ?? -1;
  set("value-latency", latency < 0 ? "–" : fixed(latency, 1));
    const counts = { tracked: 0, inferred: 0, lost: 0 };
  message?.markers?.status.forEach((status) => counts[status]++);
  for (const [name, count] of Object.entries(counts)) set(`count-${name}`, message?.markers ? count : "–");
  const total = s?.state?.source.total;
  set("frame-number", message ? (total ? `${message.seq + 1} of ${total}` : message.seq) : "–");
  set("frame-time", message ? clock(message.t) : "–");
  set("shown", s ? `${s.shown.length}/s` : "–");
  const bar = $("progress");
  bar.hidden = !total;
  if (total) bar.value = message ? (message.seq + 1) / total : 0;
}

function drawStats(s) {
  const stats = s?.stats;
  set("rate", s && s.rate !== null ? `${s.rate.toFixed(s.rate < 10 ? 1 : 0)}/s` : "–");
  set("screen", s?.screen ? `${Math.round(s.screen)} ms` : "–");
  set("dropped", stats ? grouped(stats.dropped) : "–");
  const body = $("stage-rows");
  if (!stats) {
    body.replaceChildren(row("quiet", [["no statistics yet", { colSpan: 5, className: "quiet" }]]));
    set("links", "");
    return;
  }
  const entries = [
    // The source's time is mostly waiting for the next frame.
    ...Object.entries(stats.stages).map(([id, node], index) => ({ id, node, kind: index ? "stage" : "source" })),
    ...Object.entries(stats.sinks).map(([id, node]) => ({ id, node, kind: "sink" })),
  ];
  const busiest = Math.max(1e-9, ...entries.filter((e) => e.kind !== "source").map(({ node }) => node.p50_ms ?? 0));
  body.replaceChildren(...entries.map(({ id, node, kind }) => {
    const bar = document.createElement("span");
    bar.hidden = kind === "source";
    bar.style.width = `${(100 * (node.p50_ms ?? 0)) / busiest}%`;
    return row(kind, [
      [id],
      [bar, { className: "bar" }],
      [milliseconds(node.p50_ms)],
      [milliseconds(node.p99_ms)],
      [skips(node), { className: "skips", title: `ran ${node.runs} times` }],
    ]);
  }));
  set("links", Object.entries(stats.links)
    .map(([id, l]) => `${id.replace("->", " → ")}: ${l.drops ? `${grouped(l.drops)} of ${grouped(l.offered)} dropped` : "none dropped"} (${l.policy})`)
    .join(" · "));
}

function row(className, cells) {
  const tr = document.createElement("tr");
  tr.className = className;
  for (const [content, properties] of cells) {
    const td = Object.assign(document.createElement("td"), properties);
    td.append(content);
    tr.append(td);
  }
  return tr;
}

function skips(node) {
  const skipped = Object.entries(node.skips).filter(([, count]) => count > 0);
  const all = skipped.reduce((sum, [, count]) => sum + count, node.runs);
  const parts = skipped.map(([reason, count]) => `${percent(count / all)} ${reason.replaceAll("_", " ")}`);
  if (node.errors) parts.unshift(`${node.errors} errors`);
  return parts.join(", ") || "–";
}

// Sensors of this run, and those that other processes of a run of several serve on pages of their own.
function tabs() {
  const all = new Map([...sensors.keys()].map((name) => [name, null]));
  for (const { state } of sensors.values()) {
    for (const [name, port] of Object.entries(state?.neighbours ?? {})) if (!all.has(name)) all.set(name, port);
  }
  return new Map([...all].sort(([a], [b]) => (a < b ? -1 : 1)));
}

function drawTabs() {
  const focused = $("tabs").contains(document.activeElement);
  $("tabs").replaceChildren(...[...tabs().keys()].map((name) => {
    const tab = document.createElement("button");
    const chosen = name === current;
    Object.assign(tab, { type: "button", textContent: name, tabIndex: chosen ? 0 : -1 });
    tab.setAttribute("role", "tab");
    tab.setAttribute("aria-selected", String(chosen));
    tab.setAttribute("aria-controls", "sensor");
    tab.addEventListener("click", () => choose(name));
    return tab;
  }));
  if (focused) $("tabs").querySelector('[aria-selected="true"]')?.focus();
}

function choose(name) {
  const port = tabs().get(name);
  if (port) {
    const token = connection.token ? `?token=${encodeURIComponent(connection.token)}` : "";
    location.assign(`${location.protocol}//${location.hostname}:${port}/${token}`);
    return;
  }
  current = name;
  drawTabs();
  const s = sensors.get(name);
  if (s.aspect) document.documentElement.style.setProperty("--aspect", s.aspect.toFixed(4));
  picture.show(s.bitmap, s.message);
  drawStats(s);
  schedule();
  refresh();
}

// -- state ------------------------------------------------------------------------------------------------

let shownStatus = "";

function status() {
  const s = sensors.get(current);
  if (link === "token") return "token";
  if (s?.state?.end) return "ended";
  if (link !== "open") return link === "lost" ? "disconnected" : "connecting";
  if (s?.state?.paused) return "paused";
  if (!s?.message) return "waiting";
  return performance.now() - lastFrame > STALL_SECONDS * 1000 && !document.hidden ? "stalled" : "live";
}

const ENDS = {
  eos: "The source has ended.",
  signal: "It was stopped.",
  max_frames: "It has processed as many frames as it was asked to.",
};

function refresh() {
  const now = status();
  const s = sensors.get(current);
  const state = s?.state;
  const wait = Math.max(0, Math.ceil((nextAttempt - performance.now()) / 1000));
  shownStatus = now;
  document.body.dataset.status = now;
  const silent = Math.round((performance.now() - lastFrame) / 1000);
  const texts = {
    connecting: ["Connecting", "Looking for the run."],
    token: ["Token required", "Open the address that tactflow printed, or enter the token here."],
    disconnected: ["Disconnected", `The run does not answer. ${wait ? `Next attempt in ${wait} s.` : "Trying again …"}`],
    ended: ["The run has ended", `${ENDS[state?.end] ?? state?.end ?? ""} This page comes back when a new run starts here.`],
    waiting: ["Waiting for frames", "The run is up; its source has not delivered a frame yet."],
    paused: ["Paused", "No frame was shown yet."],
    stalled: ["", ""],
    live: ["", ""],
  };
  const words = { token: "token required", ended: "ended", stalled: `no frames for ${silent} s`, waiting: "waiting for frames" };
  set("status-text", words[now] ?? now);
  const [title, text] = texts[now];
  set("empty-title", title);
  set("empty-text", text);
  const hasPicture = Boolean(s?.message);
  const show = !["live", "stalled"].includes(now) && !(now === "paused" && hasPicture);
  if (show) document.body.dataset.empty = hasPicture ? "veil" : "blank";
  else delete document.body.dataset.empty;
  $("token-form").hidden = now !== "token";
  $("retry").hidden = now !== "disconnected";
  document.title = s && now === "live" ? `${s.name} – tactflow` : `${words[now] ?? now} – tactflow`;

  set("source", state?.source.description ?? "–");
  set("source-state", state ? [state.source.live ? "live" : "recording", state.source.state ?? words[now] ?? (now === "live" ? "delivering frames" : now)].join(", ") : "");
  const open = link === "open" && state;
  for (const name of ["pause", "step", "reference", "record", "stop"]) {
    const reason = open ? state.refused[name] : "not connected";
    $(name).disabled = reason !== null;
    $(name).title = reason ?? "";
  }
  press("pause", Boolean(state?.paused), "Resume", "Pause");
  press("record", Boolean(state?.recording), "Stop recording", "Record");
}

function press(id, pressed, on, off) {
  $(id).setAttribute("aria-pressed", String(pressed));
  const label = $(id).querySelector(".label");
  if (label.textContent !== (pressed ? on : off)) label.textContent = pressed ? on : off;
}

let noteTimer = 0;

function note(text) {
  const box = $("note");
  box.textContent = text;
  box.hidden = false;
  clearTimeout(noteTimer);
  noteTimer = setTimeout(() => { box.hidden = true; }, 4000);
}

// -- buttons and keys -------------------------------------------------------------------------------------

const actions = {
  pause: () => connection.command("pause", !sensors.get(current)?.state?.paused),
  step: () => connection.command("step"),
  reference: () => { connection.command("reference"); note("the next frames become the reference"); },
  record: () => connection.command("record", !sensors.get(current)?.state?.recording),
  stop: () => connection.command("stop"),
};
const keys = { " ": "pause", s: "step", n: "reference", r: "record", q: "stop" };
for (const [id, action] of Object.entries(actions)) $(id).addEventListener("click", action);

for (const layer of LAYERS) {
  const button = document.createElement("button");
  button.type = "button";
  button.id = `layer-${layer.id}`;
  button.innerHTML = '<span class="swatch" aria-hidden="true"></span><span></span><kbd aria-hidden="true"></kbd>';
  button.firstChild.style.setProperty("--colour", layer.colour);
  button.children[1].textContent = layer.label;
  button.lastChild.textContent = layer.key;
  button.setAttribute("aria-keyshortcuts", layer.key);
  button.setAttribute("aria-pressed", String(picture.layers[layer.id]));
  button.addEventListener("click", () => {
    picture.layers[layer.id] = !picture.layers[layer.id];
    button.setAttribute("aria-pressed", String(picture.layers[layer.id]));
    picture.draw();
  });
  $("layers").append(button);
  keys[layer.key] = button.id;
}
const magnify = document.createElement("button");
Object.assign(magnify, { type: "button", id: "magnify", title: "How much longer arrows are than the displacement they show" });
magnify.setAttribute("aria-keyshortcuts", "x");
const drawMagnify = () => {
  magnify.innerHTML = "<span></span><kbd aria-hidden=\"true\">x</kbd>";
  magnify.firstChild.textContent = `Arrows × ${picture.magnify}`;
};
magnify.addEventListener("click", () => {
  picture.magnify = MAGNIFICATIONS[(MAGNIFICATIONS.indexOf(picture.magnify) + 1) % MAGNIFICATIONS.length];
  drawMagnify();
  picture.draw();
});
drawMagnify();
$("layers").append(magnify);
keys.x = "magnify";

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, textarea, select")) return;
  if (event.target.matches('[role="tab"]') && ["ArrowLeft", "ArrowRight"].includes(event.key)) {
    const names = [...tabs().keys()];
    const step = event.key === "ArrowRight" ? 1 : -1;
    choose(names[(names.indexOf(current) + step + names.length) % names.length]);
    return;
  }
  // The space bar presses the button that has the focus.
  if (event.key === " " && event.target.matches("button")) return;
  const id = keys[event.key.toLowerCase()];
  if (!id || event.repeat) return;
  event.preventDefault();
  const button = $(id);
  if (button.disabled) note(`${button.querySelector(".label")?.textContent ?? id}: ${button.title}`);
  else button.click();
});

$("retry").addEventListener("click", () => connection.retryNow());
$("token-form").addEventListener("submit", (event) => {
  event.preventDefault();
  link = "connecting";
  connection.useToken($("token").value.trim());
  refresh();
});
document.addEventListener("visibilitychange", () => { if (document.hidden) hiddenSince = performance.now(); });
onPaletteChange(() => plots.forEach((plot) => plot.draw()));
setInterval(refresh, 500);
schedule();
refresh();

// -- words ------------------------------------------------------------------------------------------------

function set(id, text) {
  const element = $(id);
  text = String(text);
  if (element.textContent !== text) element.textContent = text;
}
const fixed = (value, digits) => value.toFixed(digits).replace("-", MINUS);
const grouped = (value) => Math.round(value).toLocaleString("en").replaceAll(",", "\u202f");
const milliseconds = (value) => (value === null ? "–" : value.toFixed(value < 10 ? 2 : 1));
const percent = (share) => `${share > 0 && share < 0.01 ? "<1" : Math.round(100 * share)}\u202f%`;
const clock = (t) => (t > 1e9 ? new Date(t * 1000).toLocaleTimeString("en-GB") : `${t.toFixed(2)} s`);
