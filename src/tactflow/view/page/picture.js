// The processed frame, and the results drawn over it. Coordinates of the results are pixels of the frame, with
// the centre of the top-left pixel at (0, 0).

const DARK = "rgb(0 0 0 / .65)";

export const LAYERS = [
  { id: "image", label: "Image", key: "1", colour: "var(--quiet)" },
  { id: "arrows", label: "Arrows", key: "2", colour: "var(--tracked)" },
  { id: "hull", label: "Hull", key: "3", colour: "var(--hull)" },
  { id: "axis", label: "Line and angle", key: "4", colour: "var(--axis)" },
  { id: "ellipse", label: "Ellipse", key: "5", colour: "var(--ellipse)", off: true },
  { id: "mean", label: "Mean flow", key: "6", colour: "var(--mean)" },
];

export class Picture {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.colours = readColours();
    this.layers = Object.fromEntries(LAYERS.map((layer) => [layer.id, !layer.off]));
    this.magnify = 3;
    this.bitmap = null;
    this.message = null;
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  show(bitmap, message) {
    this.bitmap = bitmap;
    this.message = message;
    this.draw();
  }

  draw() {
    const { canvas, context: c, message, layers } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.fillStyle = layers.image ? "#0a0d10" : "#14181d";
    c.fillRect(0, 0, width, height);
    if (!message) return;
    if (layers.image && this.bitmap) {
      c.imageSmoothingQuality = "medium";
      c.drawImage(this.bitmap, 0, 0, width, height);
    }
    const sx = width / message.size[0];
    const sy = height / message.size[1];
    this.at = ([x, y]) => [(x + 0.5) * sx, (y + 0.5) * sy];
    this.unit = ratio * Math.max(1, Math.min(width, height) / ratio / 480);
    c.lineJoin = c.lineCap = "round";
    if (layers.arrows && message.markers) this.drawMarkers(message.markers);
    if (message.contact) {
      if (layers.hull) this.drawHull(message.contact.hull);
      if (layers.ellipse && message.contact.ellipse) this.drawEllipse(message.contact.ellipse);
      if (layers.axis) this.drawAxis(message.contact);
      if (layers.mean && message.flow?.mean) this.drawMean(message.contact.center, message.flow.mean);
    }
  }

  // Every line has a dark rim, so that it shows on any picture.
  stroke(path, colour, width, dash = []) {
    const c = this.context;
    c.setLineDash([]);
    c.strokeStyle = DARK;
    c.lineWidth = (width + 2) * this.unit;
    if (!dash.length) c.stroke(path);
    c.setLineDash(dash.map((length) => length * this.unit));
    if (dash.length) c.stroke(path);
    c.strokeStyle = colour;
    c.lineWidth = width * this.unit;
    c.stroke(path);
    c.setLineDash([]);
  }

  drawMarkers({ origin, position, status }) {
    const lines = { tracked: new Path2D(), inferred: new Path2D(), lost: new Path2D() };
    const heads = { tracked: new Path2D(), inferred: new Path2D() };
    const c = this.context;
    const u = this.unit;
    for (let i = 0; i < position.length; i++) {
      const kind = status[i];
      if (kind === "lost") {
        const [x, y] = this.at(position[i]);
        const r = 3 * u;
        lines.lost.moveTo(x - r, y - r);
        lines.lost.lineTo(x + r, y + r);
        lines.lost.moveTo(x - r, y + r);
        lines.lost.lineTo(x + r, y - r);
        continue;
      }
      const [x0, y0] = this.at(origin[i]);
      const [xp, yp] = this.at(position[i]);
      const dx = (xp - x0) * this.magnify;
      const dy = (yp - y0) * this.magnify;
      const length = Math.hypot(dx, dy);
      if (length < 3 * u) {
        heads[kind].moveTo(x0 + 1.8 * u, y0);
        heads[kind].arc(x0, y0, 1.8 * u, 0, 2 * Math.PI);
        continue;
      }
      arrow(lines[kind], heads[kind], x0, y0, dx, dy, length, Math.min(6 * u, Math.max(3.5 * u, length * 0.35)));
    }
    this.stroke(lines.tracked, this.colours.tracked, 1.6);
    this.stroke(lines.inferred, this.colours.inferred, 1.6, [4, 3]);
    c.globalAlpha = 0.55;
    this.stroke(lines.lost, this.colours.lost, 1.4);
    c.globalAlpha = 1;
    this.stroke(heads.tracked, this.colours.tracked, 0.8);
    c.fillStyle = this.colours.tracked;
    c.fill(heads.tracked);
    this.stroke(heads.inferred, this.colours.inferred, 1.2);
  }

  drawHull(hull) {
    if (hull.length < 2) return;
    const path = new Path2D();
    hull.forEach((point, i) => path[i ? "lineTo" : "moveTo"](...this.at(point)));
    path.closePath();
    this.stroke(path, this.colours.hull, 2);
  }

  drawEllipse({ center, axes, angle }) {
    const [x, y] = this.at(center);
    const [x1, y1] = this.at([center[0] + 1, center[1] + 1]);
    const path = new Path2D();
    path.ellipse(x, y, (axes[0] / 2) * (x1 - x), (axes[1] / 2) * (y1 - y), radians(-(angle ?? 0)), 0, 2 * Math.PI);
    this.stroke(path, this.colours.ellipse, 1.6, [7, 4]);
  }

  drawAxis({ center, angle, hull }) {
    const c = this.context;
    const u = this.unit;
    const [x, y] = this.at(center);
    const dot = new Path2D();
    dot.arc(x, y, 3.5 * u, 0, 2 * Math.PI);
    if (angle !== null) {
      const ux = Math.cos(radians(angle));
      const uy = -Math.sin(radians(angle));
      // As long as the contact is in that direction, and a little more.
      const along = hull.map(([hx, hy]) => (hx - center[0]) * ux + (hy - center[1]) * uy);
      const low = Math.min(0, ...along) - 10;
      const high = Math.max(0, ...along) + 10;
      const path = new Path2D();
      path.moveTo(...this.at([center[0] + low * ux, center[1] + low * uy]));
      path.lineTo(...this.at([center[0] + high * ux, center[1] + high * uy]));
      this.stroke(path, this.colours.axis, 2.2);
      const [tx, ty] = this.at([center[0] + high * ux, center[1] + high * uy]);
      this.label(`${angle.toFixed(1).replace("-", "−")}°`, tx, ty, ux >= 0 ? 1 : -1);
    }
    this.stroke(dot, this.colours.axis, 1.5);
    c.fillStyle = this.colours.axis;
    c.fill(dot);
  }

  label(text, x, y, side) {
    const c = this.context;
    const u = this.unit;
    c.font = `600 ${13 * u}px system-ui, "DejaVu Sans", sans-serif`;
    const width = c.measureText(text).width;
    const left = side > 0 ? x + 6 * u : x - 6 * u - width;
    x = Math.min(Math.max(left, 4 * u), this.canvas.width - width - 4 * u);
    y = Math.min(Math.max(y, 12 * u), this.canvas.height - 12 * u);
    c.textBaseline = "middle";
    c.lineWidth = 4 * u;
    c.strokeStyle = DARK;
    c.strokeText(text, x, y);
    c.fillStyle = "#fff";
    c.fillText(text, x, y);
  }

  drawMean(center, mean) {
    const [x, y] = this.at(center);
    const [xe, ye] = this.at([center[0] + mean[0] * this.magnify, center[1] + mean[1] * this.magnify]);
    const length = Math.hypot(xe - x, ye - y);
    if (length < 3 * this.unit) return;
    const line = new Path2D();
    const head = new Path2D();
    arrow(line, head, x, y, xe - x, ye - y, length, Math.min(11 * this.unit, length * 0.6));
    this.stroke(line, this.colours.mean, 3.5);
    this.stroke(head, this.colours.mean, 1);
    this.context.fillStyle = this.colours.mean;
    this.context.fill(head);
  }
}

function arrow(line, head, x, y, dx, dy, length, size) {
  const ux = dx / length;
  const uy = dy / length;
  const bx = x + dx - ux * size;
  const by = y + dy - uy * size;
  line.moveTo(x, y);
  line.lineTo(bx, by);
  head.moveTo(x + dx, y + dy);
  head.lineTo(bx - uy * size * 0.5, by + ux * size * 0.5);
  head.lineTo(bx + uy * size * 0.5, by - ux * size * 0.5);
  head.closePath();
}

const radians = (degrees) => (degrees * Math.PI) / 180;

function readColours() {
  const style = getComputedStyle(document.documentElement);
  const names = ["tracked", "inferred", "lost", "hull", "axis", "ellipse", "mean"];
  return Object.fromEntries(names.map((name) => [name, style.getPropertyValue(`--${name}`).trim()]));
}
