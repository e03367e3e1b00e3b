// A line plot of the last ten seconds, with gaps at missing values.

export const SECONDS = 10;
const GAP = 0.6;  // s; maximum distance of joined points
const LEFT = 34;
const TOP = 6;
const SERIES = [
  { colour: "series-a", dash: [] },
  { colour: "series-b", dash: [5, 3] },
  { colour: "series-c", dash: [1.5, 3] },
];

export class Plot {
  // series: functions (point, unit) -> number or null. range: [low, high], "positive", "symmetric", or "signed"
  // (symmetric only with negative values). minimum: of the upper limit, or unit -> minimum.
  constructor(canvas, { series, range, jump = Infinity, minimum = 1, format = short }) {
    Object.assign(this, { canvas, series, range, jump, minimum, format });
    this.context = canvas.getContext("2d", { alpha: false });
    this.ground = new OffscreenCanvas(1, 1);
    this.colours = null;
    this.ratio = 0;
    this.points = [];
    this.unit = "px";
  }

  choose(unit) {
    this.unit = unit;
    this.drawn = null;
    this.draw();
  }

  resize(width, height, ratio) {
    this.ratio = ratio;
    for (const canvas of [this.canvas, this.ground]) Object.assign(canvas, { width, height });
    this.drawn = null;
    this.draw();
  }

  recolour(colours) {
    this.colours = colours;
    this.drawn = null;
    this.draw();
  }

  draw(points = this.points) {
    this.points = points;
    if (!this.colours || !this.ratio) return;
    const { canvas, context: c, ratio, colours } = this;
    const w = canvas.width / ratio;
    const h = canvas.height / ratio;
    const [low, high] = this.limits(points);
    const bottom = h - 14;
    const end = points.length ? points[points.length - 1].t : 0;
    const x = (t) => w - 2 + ((t - end) / SECONDS) * (w - 2 - LEFT);
    const y = (value) => bottom - ((value - low) / (high - low)) * (bottom - TOP);
    if (this.drawn !== `${low} ${high}`) this.drawGround(w, h, [low, (low + high) / 2, high], y);
    this.drawn = `${low} ${high}`;
    c.setTransform(1, 0, 0, 1, 0, 0);
    c.drawImage(this.ground, 0, 0);
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.lineWidth = 1.8;
    c.lineJoin = "round";
    this.series.forEach((pick, index) => {
      c.strokeStyle = c.fillStyle = colours[SERIES[index].colour];
      c.setLineDash(SERIES[index].dash);
      c.beginPath();
      let last = null;
      for (const point of points) {
        const value = pick(point, this.unit);
        if (value === null) {
          last = null;
          continue;
        }
        const joined = last !== null && point.t - last.t < GAP && Math.abs(value - last.value) < this.jump;
        c[joined ? "lineTo" : "moveTo"](x(point.t), y(value));
        last = { t: point.t, value };
      }
      c.stroke();
      if (last !== null && last.t === end) {
        c.setLineDash([]);
        c.beginPath();
        c.arc(x(last.t) - 1, y(last.value), 2.6, 0, 2 * Math.PI);
        c.fill();
      }
    });
  }

  // Grid lines and labels rarely change; they are drawn once and copied.
  drawGround(w, h, values, y) {
    const { colours, ratio } = this;
    const c = this.ground.getContext("2d", { alpha: false });
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    c.fillStyle = colours.panel;
    c.fillRect(0, 0, w, h);
    c.font = '10px system-ui, "DejaVu Sans", sans-serif';
    c.textAlign = "right";
    c.textBaseline = "middle";
    c.lineWidth = 1;
    for (const value of values) {
      const line = Math.round(y(value)) + 0.5;
      c.strokeStyle = colours.grid;
      c.beginPath();
      c.moveTo(LEFT, line);
      c.lineTo(w, line);
      c.stroke();
      c.fillStyle = colours.quiet;
      c.fillText(this.format(value), LEFT - 5, Math.min(Math.max(line, 5), h - 5));
    }
    c.textBaseline = "alphabetic";
    for (const [seconds, align] of [[10, "left"], [5, "center"], [0, "right"]]) {
      c.textAlign = align;
      c.fillText(seconds ? `−${seconds} s` : "now", w - 2 - (seconds / SECONDS) * (w - 2 - LEFT), h - 2);
    }
  }

  limits(points) {
    if (Array.isArray(this.range)) return this.range;
    const values = points.flatMap((point) => this.series.map((pick) => pick(point, this.unit) ?? 0));
    const high = nice(Math.max(this.minimum[this.unit] ?? this.minimum, ...values.map(Math.abs)));
    const below = this.range === "symmetric" || (this.range === "signed" && Math.min(...values) < 0);
    return [below ? -high : 0, high];
  }
}

// Round up to 1, 2, 4, 6, 8 or 10 times a power of ten: limits that can be halved and rarely change.
function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 4, 6, 8, 10].find((step) => step * power >= value * 0.999) * power;
}

function short(value) {
  const size = Math.abs(value);
  const text = size >= 1e6 ? `${trim(value / 1e6)}M` : size >= 1e4 ? `${trim(value / 1e3)}k` : trim(value);
  return text.replace("-", "−");
}

const trim = (value) => String(Number(value.toPrecision(3)));
