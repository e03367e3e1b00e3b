// The page: a tab per sensor, values and statistics, and buttons that control the run. A worker draws the picture and
// the plots and holds the connection to the run.

import { RAMP } from "./surface.js";
import * as words from "./words.js";

const { fixed, grouped } = words;
const $ = (id) => document.getElementById(id);
const STALL_SECONDS = 2;
// Magnifications of arrows and of the surface.
const FACTORS = [1, 3, 5, 10];
const PLOTS = ["area", "angle", "flow", "latency", "depth", "force", "slip", "pose"].map((name) => `plot-${name}`);
const CANVASES = ["picture", "surface", ...PLOTS];
const COLOURS = ["tracked", "inferred", "lost", "field", "hull", "axis", "ellipse", "mean", "series-a", "series-b", "series-c", "grid", "quiet", "panel", "well"];
const LAYERS = [
  { id: "image", label: "Image", key: "1", colour: "var(--quiet)" },
  { id: "arrows", label: "Arrows", key: "2", colour: "var(--tracked)" },
  { id: "hull", label: "Hull", key: "3", colour: "var(--hull)" },
  { id: "axis", label: "Line and angle", key: "4", colour: "var(--axis)" },
  { id: "ellipse", label: "Ellipse", key: "5", colour: "var(--ellipse)", off: true },
  { id: "mean", label: "Mean flow", key: "6", colour: "var(--mean)" },
  { id: "field", label: "Field", key: "7", colour: "var(--field)", off: true, offer: "field" },
  { id: "surface", label: "Surface", key: "8", colour: `linear-gradient(90deg, ${RAMP})`, off: true, offer: "surface" },
];
// Optional tiles and buttons, and the part of a frame that they need.
const OFFERED = { "tile-guide": "guide", unit: "scale", "layer-field": "field", "layer-surface": "surface", "tile-depth": "surface", "tile-force": "force", "tile-slip": "slip", "tile-pose": "pose" };

const sensors = new Map();
const layers = Object.fromEntries(LAYERS.map((layer) => [layer.id, !layer.off]));
let magnification = 3;
let rise = 3;
let wanted = localStorage.getItem("tactflow-unit") ?? "mm";
let current = null;
let run = null;
let asked = null;  // number of the question that is shown
let link = "connecting";  // connecting, open, lost, token
let nextAttempt = 0;
let lastFrame = 0;

function sensor(name) {
  if (!sensors.has(name)) {
    sensors.set(name, { name, last: null, state: null, stats: null, rate: null });
    current ??= name;
    drawTabs();
  }
  return sensors.get(name);
}

// -- messages from the run ------------------------------------------------------------------------------

const painter = new Worker("painter.js", { type: "module" });
const order = (name, content = {}, transfer = []) => painter.postMessage({ order: name, ...content }, transfer);
const command = (name, value = null) => order("send", { message: { do: name, value } });

const news = {
  open() {
    link = "open";
    lastFrame = performance.now();
    refresh();
  },
  hello({ message }) {
    // A new run at the same address: discard the state of the previous one.
    if (run !== null && run !== message.run) {
      sensors.clear();
      current = asked = null;
    }
    run = message.run;
    message.sensors.forEach(sensor);
    drawValues(sensors.get(current));
    refresh();
  },
  state({ message }) {
    const s = sensor(message.sensor);
    const changed = JSON.stringify(message.neighbours) !== JSON.stringify(s.state?.neighbours);
    s.state = message;
    if (changed) drawTabs();
    refresh();
  },
  stats({ message }) {
    const s = sensor(message.sensor);
    const stats = message.run;
    if (!stats.stages) return;
    if (s.stats && stats.wall_s > s.stats.wall_s) {
      s.rate = Math.max(0, stats.frames - s.stats.frames) / (stats.wall_s - s.stats.wall_s);
    }
    s.stats = stats;
    if (s.name === current) drawStats(s);
    refresh();
  },
  frames({ sensor: name, summary }) {
    const s = sensor(name);
    s.last = summary;
    lastFrame = performance.now();
    if (s.name === current) {
      drawAspect(s);
      drawValues(s);
    }
    if (shownStatus !== status()) refresh();
  },
  note: ({ text, message }) => note(text ?? message.text),
  turns({ turns }) {
    document.body.dataset.turns = turns;
    if (!turns) set("turn-hint", "view from above: this browser has no WebGL");
  },
  lost({ seconds }) {
    link = "lost";
    nextAttempt = performance.now() + seconds * 1000;
    refresh();
  },
  refused() {
    link = "token";
    refresh();
    $("token").focus();
  },
};
painter.onmessage = ({ data }) => news[data.type]?.(data);

// -- drawing ----------------------------------------------------------------------------------------------

function drawAspect({ last }) {
  const value = last.aspect.toFixed(4);
  const style = document.documentElement.style;
  if (style.getPropertyValue("--aspect") !== value) style.setProperty("--aspect", value);
}

function drawValues(s) {
  const message = s?.last;
  put(document.body.dataset, "asks", String(Boolean(message?.guide?.choices)));
  drawOffers(message?.offers ?? []);
  for (const name of ["area", "angle", "flow", "depth", "force", "slip", "pose"]) {
    const [value, rest] = message ? words[name](message, unit()) : ["–", ""];
    set(`value-${name}`, value);
    set(`unit-${name}`, rest);
  }
  put($("tile-slip").dataset, "slipping", String(Boolean(message?.slip?.slipping)));
  set("deepest", message ? `${Number(message.deepest.toPrecision(1))} mm` : "");
  set("deepest-now", message?.contact?.depth_mm == null ? "no contact" : `${fixed(message.contact.depth_mm, 2)} mm deep`);
  if (message?.guide) drawGuide(message.guide);
  const latency = message?.latency ?? -1;
  set("value-latency", latency < 0 ? "–" : fixed(latency, 1));
  for (const name of ["tracked", "inferred", "lost"]) set(`count-${name}`, message?.counts?.[name] ?? "–");
  const total = s?.state?.source.total;
  set("frame-number", message ? (total ? `${message.seq + 1} of ${total}` : message.seq) : "–");
  set("frame-time", message ? clock(message.t) : "–");
  set("shown", message ? `${message.shown}/s` : "–");
  const bar = $("progress");
  put(bar, "hidden", !total);
  if (total) put(bar, "value", message ? (message.seq + 1) / total : 0);
  if (message) $("picture").dataset.seq = message.seq;
  for (const id of PLOTS) $(id).dataset.points = message?.points ?? 0;
}

function drawGuide(guide) {
  if (guide.choices) drawQuestion(guide);
  else drawPresses(guide);
}

// A question of `tactflow start`.
function drawQuestion({ number, now, notes, choices }) {
  if (asked === number) return;
  asked = number;
  set("guide-title", "Set up");
  set("guide-now", now);
  set("guide-last", notes);
  $("choices").replaceChildren(...choices.map(({ value, label }) => {
    const button = document.createElement("button");
    Object.assign(button, { type: "button", textContent: label });
    button.addEventListener("click", () => command("answer", [number, value]));
    return button;
  }));
}

function drawPresses(guide) {
  const [count, share, last, good] = words.guide(guide);
  set("guide-count", count);
  set("guide-now", guide.now);
  set("guide-last", last);
  put($("guide-last").dataset, "good", String(good));
  put($("guide-progress"), "value", share);
}

// Unit of lengths: millimetres only with a scale.
function unit() {
  return sensors.get(current)?.last?.offers.includes("scale") ? wanted : "px";
}

function drawOffers(offers) {
  for (const [id, offer] of Object.entries(OFFERED)) put($(id), "hidden", !offers.includes(offer));
  put($("tile-surface"), "hidden", !(layers.surface && offers.includes("surface")));
  put($("unit"), "ariaPressed", String(unit() === "mm"));
  put(document.body.dataset, "tiles", String(document.querySelectorAll("#plots .tile:not([hidden])").length));
  if (unit() !== orderedUnit) orderLayers();
}

function drawStats(s) {
  const stats = s?.stats;
  set("rate", s && s.rate !== null ? `${s.rate.toFixed(s.rate < 10 ? 1 : 0)}/s` : "–");
  set("dropped", stats ? grouped(stats.dropped) : "–");
  const body = $("stage-rows");
  if (!stats) {
    if (!body.querySelector("td[colspan]")) body.innerHTML = '<tr><td colspan="5" class="quiet">no statistics yet</td></tr>';
    set("links", "");
    return;
  }
  const entries = [
    // The time of the source is mostly spent waiting for frames.
    ...Object.entries(stats.stages).map(([id, node], index) => ({ id, node, kind: index ? "stage" : "source" })),
    ...Object.entries(stats.sinks).map(([id, node]) => ({ id, node, kind: "sink" })),
  ];
  if (entries.map(({ id }) => id).join() !== [...body.rows].map((row) => row.cells[0].textContent).join()) {
    body.replaceChildren(...entries.map(newRow));
  }
  const busiest = Math.max(1e-9, ...entries.filter((e) => e.kind !== "source").map(({ node }) => node.p50_ms ?? 0));
  entries.forEach(({ node }, index) => {
    const [, bar, p50, p99, skipped] = body.rows[index].cells;
    put(bar.firstChild.style, "width", `${Math.round((100 * (node.p50_ms ?? 0)) / busiest)}%`);
    put(p50, "textContent", milliseconds(node.p50_ms));
    put(p99, "textContent", milliseconds(node.p99_ms));
    put(skipped, "textContent", skips(node));
    put(skipped, "title", `ran ${node.runs} times`);
  });
  set("links", Object.entries(stats.links)
    .map(([id, l]) => `${id.replace("->", " → ")}: ${l.drops ? `${grouped(l.drops)} of ${grouped(l.offered)} dropped` : "none dropped"} (${l.policy})`)
    .join(" · "));
}

function newRow({ id, kind }) {
  const row = document.createElement("tr");
  row.className = kind;
  row.innerHTML = '<td></td><td class="bar"><span></span></td><td></td><td></td><td class="skips"></td>';
  row.cells[0].textContent = id;
  row.querySelector("span").hidden = kind === "source";
  return row;
}

function skips(node) {
  const skipped = Object.entries(node.skips).filter(([, count]) => count > 0);
  const all = skipped.reduce((sum, [, count]) => sum + count, node.runs);
  const parts = skipped.map(([reason, count]) => `${percent(count / all)} ${reason.replaceAll("_", " ")}`);
  if (node.errors) parts.unshift(`${node.errors} errors`);
  return parts.join(", ") || "–";
}

// Sensors of this process, and those of the run's other processes, which have their own pages.
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
    const query = token ? `?token=${encodeURIComponent(token)}` : "";
    location.assign(`${location.protocol}//${location.hostname}:${port}/${query}`);
    return;
  }
  current = name;
  drawTabs();
  const s = sensors.get(name);
  order("choose", { name });
  if (s.last) drawAspect(s);
  drawValues(s);
  drawStats(s);
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
  if (!s?.last) return "waiting";
  return performance.now() - lastFrame > STALL_SECONDS * 1000 && !document.hidden ? "stalled" : "live";
}

const ENDS = {
  eos: "The source has ended.",
  signal: "The run was stopped.",
  max_frames: "The requested number of frames has been processed.",
};

function refresh() {
  const now = status();
  const s = sensors.get(current);
  const state = s?.state;
  const wait = Math.max(0, Math.ceil((nextAttempt - performance.now()) / 1000));
  shownStatus = now;
  put(document.body.dataset, "status", now);
  const silent = Math.round((performance.now() - lastFrame) / 1000);
  const texts = {
    connecting: ["Connecting", "Connecting to the run."],
    token: ["Token required", "Open the address that tactflow printed, or enter the token here."],
    disconnected: ["Disconnected", `The run does not answer. ${wait ? `Next attempt in ${wait} s.` : "Trying again …"}`],
    ended: s?.last?.guide?.choices ? ["Set up", "The live results appear here when the pipeline runs."] : s?.last?.guide ? ["All presses are recorded", "The terminal shows the result of the calibration."] : ["The run has ended", `${ENDS[state?.end] ?? state?.end ?? ""} This page reconnects when a new run starts at this address.`],
    waiting: ["Waiting for frames", "The run has started, but its source has not delivered a frame yet."],
    paused: ["Paused", "No frame has been shown yet."],
    stalled: ["", ""],
    live: ["", ""],
  };
  const labels = { token: "token required", ended: "ended", stalled: `no frames for ${silent} s`, waiting: "waiting for frames" };
  set("status-text", labels[now] ?? now);
  const [title, text] = texts[now];
  set("empty-title", title);
  set("empty-text", text);
  const hasPicture = Boolean(s?.last);
  const show = !["live", "stalled"].includes(now) && !(now === "paused" && hasPicture);
  put(document.body.dataset, "empty", show ? (hasPicture ? "veil" : "blank") : "no");
  put($("token-form"), "hidden", now !== "token");
  put($("retry"), "hidden", now !== "disconnected");
  put(document, "title", s && now === "live" ? `${s.name} – tactflow` : `${labels[now] ?? now} – tactflow`);

  set("source", state?.source.description ?? "–");
  set("source-state", state ? [state.source.live ? "live" : "recording", (link === "open" && !state.end && state.source.state) || labels[now] || (now === "live" ? "delivering frames" : now)].join(", ") : "");
  const open = link === "open" && state;
  for (const name of ["pause", "step", "reference", "record", "stop"]) {
    const reason = open ? state.refused[name] : "not connected";
    put($(name), "disabled", reason !== null);
    put($(name), "title", reason ?? "");
  }
  press("pause", Boolean(state?.paused), "Resume", "Pause");
  const guided = Boolean(s?.last?.guide);
  put($("stop").querySelector(".label"), "textContent", guided ? "Finish" : "Stop");
  press("record", Boolean(state?.recording), "Stop recording", "Record");
  // A CSS animation would repaint the page at every refresh of the screen.
  put($("record").dataset, "beat", String(Number(Boolean(state?.recording)) && Math.floor(performance.now() / 500) % 2));
}

function press(id, pressed, on, off) {
  put($(id), "ariaPressed", String(pressed));
  put($(id).querySelector(".label"), "textContent", pressed ? on : off);
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
  pause: () => command("pause", !sensors.get(current)?.state?.paused),
  step: () => command("step"),
  reference: () => { command("reference"); note("the next frames become the reference"); },
  record: () => command("record", !sensors.get(current)?.state?.recording),
  stop: () => command("stop"),
};
let orderedUnit = null;
function orderLayers() {
  orderedUnit = unit();
  order("layers", { layers, magnify: magnification, rise, unit: orderedUnit });
}
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
  button.setAttribute("aria-pressed", String(layers[layer.id]));
  button.addEventListener("click", () => {
    layers[layer.id] = !layers[layer.id];
    button.setAttribute("aria-pressed", String(layers[layer.id]));
    orderLayers();
    drawValues(sensors.get(current));
  });
  $("layers").append(button);
  keys[layer.key] = button.id;
}
// A button that cycles through factors.
function addFactor(id, key, title, factors, text, choose) {
  const button = document.createElement("button");
  Object.assign(button, { type: "button", id, title });
  button.setAttribute("aria-keyshortcuts", key);
  button.innerHTML = `<span></span><kbd aria-hidden="true">${key}</kbd>`;
  let chosen = factors.indexOf(3);
  const draw = () => { button.firstChild.textContent = `${text} × ${factors[chosen]}`; };
  button.addEventListener("click", () => {
    chosen = (chosen + 1) % factors.length;
    choose(factors[chosen]);
    draw();
    orderLayers();
  });
  draw();
  keys[key] = id;
  return button;
}
$("layers").append(
  addFactor("magnify", "x", "Magnification of the arrows", FACTORS, "Arrows", (factor) => { magnification = factor; }),
  $("unit"),
);
$("surface-tools").prepend(
  addFactor("rise", "z", "Magnification of the heights", FACTORS, "Heights", (factor) => { rise = factor; }),
);
document.querySelector("#ramp i").style.background = `linear-gradient(90deg, ${RAMP})`;
keys.u = "unit";
$("unit").addEventListener("click", () => {
  wanted = wanted === "mm" ? "px" : "mm";
  localStorage.setItem("tactflow-unit", wanted);
  drawValues(sensors.get(current));
});

// Drag the surface, or use the arrow keys when it has the focus.
const TURNS = { ArrowLeft: [-20, 0], ArrowRight: [20, 0], ArrowUp: [0, 20], ArrowDown: [0, -20], Home: [] };
$("surface").addEventListener("keydown", (event) => {
  const turn = TURNS[event.key];
  if (!turn) return;
  event.preventDefault();
  order("turn", { dx: turn[0], dy: turn[1] });
});
$("surface").addEventListener("pointerdown", (event) => $("surface").setPointerCapture(event.pointerId));
$("surface").addEventListener("pointermove", (event) => {
  if (event.buttons & 1) order("turn", { dx: event.movementX, dy: event.movementY });
});
$("surface").addEventListener("dblclick", () => order("turn"));

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || event.target.matches("input, textarea, select")) return;
  if (event.target.matches('[role="tab"]') && ["ArrowLeft", "ArrowRight"].includes(event.key)) {
    const names = [...tabs().keys()];
    const step = event.key === "ArrowRight" ? 1 : -1;
    choose(names[(names.indexOf(current) + step + names.length) % names.length]);
    return;
  }
  // Space activates the focused button.
  if (event.key === " " && event.target.matches("button")) return;
  const id = keys[event.key.toLowerCase()];
  if (!id || event.repeat) return;
  event.preventDefault();
  const button = $(id);
  if (button.closest("[hidden]")) return;
  if (button.disabled) note(`${button.querySelector(".label")?.textContent ?? id}: ${button.title}`);
  else button.click();
});

$("retry").addEventListener("click", () => order("retry"));
$("token-form").addEventListener("submit", (event) => {
  event.preventDefault();
  link = "connecting";
  token = $("token").value.trim();
  sessionStorage.setItem("tactflow-token", token);
  order("token", { token });
  refresh();
});

// -- the worker ------------------------------------------------------------------------------

// Move a token from the address bar to the storage of this tab.
function takeToken() {
  const url = new URL(location.href);
  const shown = url.searchParams.get("token");
  if (shown) {
    sessionStorage.setItem("tactflow-token", shown);
    url.searchParams.delete("token");
    history.replaceState(null, "", url);
  }
  return shown ?? sessionStorage.getItem("tactflow-token");
}

function orderColours() {
  const style = getComputedStyle(document.documentElement);
  order("colours", { colours: Object.fromEntries(COLOURS.map((name) => [name, style.getPropertyValue(`--${name}`).trim()])) });
}

function orderSizes(ids) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  for (const id of ids) {
    const [width, height] = [$(id).clientWidth, $(id).clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));
    order("resize", { id, width, height, ratio });
  }
}

let token = takeToken();
const canvases = Object.fromEntries(CANVASES.map((id) => [id, $(id).transferControlToOffscreen()]));
order("begin", { canvases, token, hidden: document.hidden }, Object.values(canvases));
orderColours();
orderLayers();
const sizes = new ResizeObserver((entries) => orderSizes(entries.map((entry) => entry.target.id)));
CANVASES.forEach((id) => sizes.observe($(id)));
document.addEventListener("visibilitychange", () => order("hide", { hidden: document.hidden }));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", orderColours);
setInterval(refresh, 500);
drawValues(null);
refresh();

// -- text ------------------------------------------------------------------------------------------------

// Writing an unchanged value would still trigger a layout.
function put(thing, property, value) {
  if (thing[property] !== value) thing[property] = value;
}
function set(id, text) {
  put($(id), "textContent", String(text));
}
const milliseconds = (value) => (value === null ? "–" : value.toFixed(value < 10 ? 2 : 1));
const percent = (share) => `${share > 0 && share < 0.01 ? "<1" : Math.round(100 * share)}\u202f%`;
const clock = (t) => (t > 1e9 ? new Date(t * 1000).toLocaleTimeString("en-GB") : `${t.toFixed(2)} s`);
