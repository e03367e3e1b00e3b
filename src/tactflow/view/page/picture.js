// The processed frame with the results drawn over it. Coordinates are pixels of the frame, with the centre of the
// top-left pixel at (0, 0).

const DARK = "rgb(0 0 0 / .65)";

export class Picture {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", { alpha: false });
    this.colours = null;
    this.layers = null;
    this.magnify = 1;
    this.units = "px";
    this.ratio = 0;
    this.bitmap = null;
    this.header = null;
  }

  resize(width, height, ratio) {
    this.ratio = ratio;
    Object.assign(this.canvas, { width, height });
    this.draw();
  }

  recolour(colours) {
    this.colours = colours;
    this.draw();
  }

  // layers: name -> whether it is shown. magnify: magnification of arrows. units: "px" or "mm".
  choose(layers, magnify, units) {
    this.layers = layers;
    this.magnify = magnify;
    this.units = units;
    this.draw();
  }

  // header: of the frame.
  show(bitmap, header) {
    this.bitmap = bitmap;
    this.header = header;
    this.draw();
  }

  draw() {
    const { canvas, context: c, layers, ratio } = this;
    if (!layers || !this.colours || !ratio) return;
    const { width, height } = canvas;
    if (layers.image && this.bitmap) {
      c.drawImage(this.bitmap, 0, 0, width, height);
    } else {
      c.fillStyle = layers.image ? "#0a0d10" : "#14181d";
      c.fillRect(0, 0, width, height);
    }
    if (!this.header) return;
    const { message, markers, field, scale, guide } = this.header;
    const sx = width / message.size[0];
    const sy = height / message.size[1];
    this.at = ([x, y]) => [(x + 0.5) * sx, (y + 0.5) * sy];
    this.unit = ratio * Math.max(1, Math.min(width, height) / ratio / 480);
    c.lineJoin = c.lineCap = "round";
    if (guide?.next) this.drawGuide(guide);
    if (layers.field && field?.origin) this.drawField(field);
    if (layers.arrows && markers) this.drawMarkers(markers);
    if (message.contact) {
      if (layers.hull) this.drawHull(message.contact.hull);
      if (layers.ellipse && message.contact.ellipse) this.drawEllipse(message.contact.ellipse);
      if (layers.axis) this.drawAxis(message.contact);
      if (layers.mean && message.flow?.mean) this.drawMean(message.contact.center, message.flow.mean);
    }
    if (this.units === "mm" && scale) this.drawRuler(sx / scale[0]);
  }

  // Lines have a dark outline, to be visible on any picture.
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

  // Filling polygons is much faster than stroking lines, so the arrows of the many tracked markers are filled twice:
  // slightly larger for the outline, then in their colour.
  drawMarkers({ origin, position, status }) {
    const tracked = { rim: new Path2D(), body: new Path2D() };
    const inferred = { line: new Path2D(), head: new Path2D() };
    const lost = new Path2D();
    const c = this.context;
    const u = this.unit;
    const point = (points, i) => this.at([points[2 * i] / 10, points[2 * i + 1] / 10]);
    for (let i = 0; i < status.length; i++) {
      const [xp, yp] = point(position, i);
      if (status[i] === "l") {
        const r = 3 * u;
        lost.moveTo(xp - r, yp - r);
        lost.lineTo(xp + r, yp + r);
        lost.moveTo(xp - r, yp + r);
        lost.lineTo(xp + r, yp - r);
        continue;
      }
      const isTracked = status[i] === "t";
      const [x0, y0] = point(origin, i);
      const dx = (xp - x0) * this.magnify;
      const dy = (yp - y0) * this.magnify;
      const length = Math.hypot(dx, dy);
      const size = Math.min(6 * u, Math.max(3.5 * u, length * 0.35));
      if (length < 3 * u) {
        if (isTracked) {
          octagon(tracked.rim, x0, y0, 3.2 * u);
          octagon(tracked.body, x0, y0, 2.2 * u);
        } else {
          inferred.head.moveTo(x0 + 1.8 * u, y0);
          inferred.head.arc(x0, y0, 1.8 * u, 0, 2 * Math.PI);
        }
      } else if (isTracked) {
        solidArrow(tracked.rim, x0, y0, dx / length, dy / length, length, size, 1.8 * u, 1.4 * u);
        solidArrow(tracked.body, x0, y0, dx / length, dy / length, length, size, 0.8 * u, 0.4 * u);
      } else {
        arrow(inferred.line, inferred.head, x0, y0, dx, dy, length, size);
      }
    }
    if (status.includes("i")) this.stroke(inferred.line, this.colours.inferred, 1.6, [4, 3]);
    if (status.includes("l")) {
      c.globalAlpha = 0.55;
      this.stroke(lost, this.colours.lost, 1.4);
      c.globalAlpha = 1;
    }
    c.fillStyle = DARK;
    c.fill(tracked.rim);
    c.fillStyle = this.colours.tracked;
    c.fill(tracked.body);
    if (status.includes("i")) this.stroke(inferred.head, this.colours.inferred, 1.2);
  }

  // Displacement of the gel between the markers, in tenths of a pixel.
  drawField({ origin, position }) {
    const rim = new Path2D();
    const body = new Path2D();
    const u = this.unit;
    for (let i = 0; i < origin.length; i += 2) {
      const [x, y] = this.at([origin[i] / 10, origin[i + 1] / 10]);
      const [xe, ye] = this.at([position[i] / 10, position[i + 1] / 10]);
      const length = Math.hypot(xe - x, ye - y) * this.magnify;
      if (length < 2 * u) continue;
      const [ux, uy] = [((xe - x) * this.magnify) / length, ((ye - y) * this.magnify) / length];
      const size = Math.min(4.5 * u, length * 0.45);
      solidArrow(rim, x, y, ux, uy, length, size, 1.2 * u, 1.1 * u);
      solidArrow(body, x, y, ux, uy, length, size, 0.5 * u, 0.3 * u);
    }
    this.context.fillStyle = DARK;
    this.context.fill(rim);
    this.context.fillStyle = this.colours.field;
    this.context.fill(body);
  }

  // Positions of presses, and the cell of the gel for the next one.
  drawGuide({ presses, next: [row, column], lasts }) {
    const { width, height } = this.canvas;
    const c = this.context;
    if (!lasts) {
      c.fillStyle = "rgb(255 255 255 / .16)";
      c.fillRect((column * width) / 3, (row * height) / 3, width / 3, height / 3);
    }
    const parts = new Path2D();
    for (const share of [1 / 3, 2 / 3]) {
      parts.moveTo(share * width, 0);
      parts.lineTo(share * width, height);
      parts.moveTo(0, share * height);
      parts.lineTo(width, share * height);
    }
    c.strokeStyle = "rgb(255 255 255 / .35)";
    c.lineWidth = this.unit;
    c.stroke(parts);
    for (const { center, radius, fault } of presses) {
      const [x, y] = this.at(center);
      const [edge] = this.at([center[0] + radius, center[1]]);
      const round = new Path2D();
      round.arc(x, y, edge - x, 0, 2 * Math.PI);
      this.stroke(round, fault === null ? this.colours.ellipse : this.colours.mean, 1.5, fault === null ? [] : [3, 4]);
    }
  }

  // A scale bar of 1, 2 or 5 times a power of ten mm, about a fifth of the picture. pixels: of the canvas per mm.
  drawRuler(pixels) {
    const { width, height } = this.canvas;
    const u = this.unit;
    const power = 10 ** Math.floor(Math.log10((0.3 * width) / pixels));
    const length = [5, 2, 1].find((step) => step * power * pixels <= 0.3 * width) * power;
    const [x, y] = [width - 12 * u, height - 14 * u];
    const bar = new Path2D();
    bar.moveTo(x, y - 3 * u);
    bar.lineTo(x, y);
    bar.lineTo(x - length * pixels, y);
    bar.lineTo(x - length * pixels, y - 3 * u);
    this.stroke(bar, "#fff", 1.6);
    this.label(`${Number(length.toPrecision(1))} mm`, x + 6 * u, y - 13 * u, -1);
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
      // Slightly longer than the contact in that direction.
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

// Outline of shaft and head. half: half the width of the shaft. more: enlargement of the head.
function solidArrow(path, x, y, ux, uy, length, size, half, more) {
  const wide = size * 0.5 + 1.2 * more;
  const neck = length - size - more;
  const to = (along, across) => path.lineTo(x + along * ux - across * uy, y + along * uy + across * ux);
  path.moveTo(x - half * ux - half * uy, y - half * uy + half * ux);
  to(neck, half);
  to(neck, wide);
  to(length + 1.3 * more, 0);
  to(neck, -wide);
  to(neck, -half);
  to(-half, -half);
  path.closePath();
}

function octagon(path, x, y, radius) {
  const a = radius;
  const b = radius * Math.SQRT1_2;
  path.moveTo(x + a, y);
  path.lineTo(x + b, y + b);
  path.lineTo(x, y + a);
  path.lineTo(x - b, y + b);
  path.lineTo(x - a, y);
  path.lineTo(x - b, y - b);
  path.lineTo(x, y - a);
  path.lineTo(x + b, y - b);
  path.closePath();
}

const radians = (degrees) => (degrees * Math.PI) / 180;
