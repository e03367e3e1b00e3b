// A line plot of the last ten seconds. A missing value leaves a gap: nothing is invented between two contacts.

export const SECONDS = 10;
const GAP = 0.6;  // s; points further apart are not joined

export class Plot {
  // series: one function (point) -> number or null each. range: [low, high], or "positive", or "symmetric".
  constructor(canvas, { series, range, jump = Infinity, minimum = 1, format = short }) {
    Object.assign(this, { canvas, series, range, jump, minimum, format });
    this.context = canvas.getContext("2d");
    this.points = [];
    new ResizeObserver(() => this.draw()).observe(canvas);
  }

  draw(points = this.points) {
    this.points = points;
    const { canvas, context: c } = this;
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
    c.setTransform(ratio, 0, 0, ratio, 0, 0);
    const w = width / ratio;
    const h = height / ratio;
    c.clearRect(0, 0, w, h);
    const colours = palette();
    const [low, high] = this.limits(points);
    const left = 34;
    const top = 6;
    const bottom = h - 14;
    const end = points.length ? points[points.length - 1].t : 0;
    const x = (t) => w - 2 + ((t - end) / SECONDS) * (w - 2 - left);
    const y = (value) => bottom - ((value - low) / (high - low)) * (bottom - top);

    c.font = '10px system-ui, "DejaVu Sans", sans-serif';
    c.textAlign = "right";
    c.textBaseline = "middle";
    c.lineWidth = 1;
    for (const value of [low, (low + high) / 2, high]) {
      const line = Math.round(y(value)) + 0.5;
      c.strokeStyle = colours.grid;
      c.beginPath();
      c.moveTo(left, line);
      c.lineTo(w, line);
      c.stroke();
      c.fillStyle = colours.quiet;
      c.fillText(this.format(value), left - 5, Math.min(Math.max(line, 5), h - 5));
    }
    c.textBaseline = "alphabetic";
    for (const seconds of [10, 5, 0]) {
      c.textAlign = seconds === 0 ? "right" : seconds === 10 ? "left" : "center";
      c.fillText(seconds === 0 ? "now" : `−${seconds} s`, x(end - seconds), h - 2);
    }

    c.save();
    c.beginPath();
    c.rect(left, 0, w - left, h);
    c.clip();
    c.lineWidth = 1.8;
    c.lineJoin = "round";
    this.series.forEach((pick, index) => {
      c.strokeStyle = c.fillStyle = index ? colours.b : colours.a;
      c.setLineDash(index ? [5, 3] : []);
      c.beginPath();
      let last = null;
      for (const point of points) {
        const value = pick(point);
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
    c.restore();
    canvas.dataset.points = String(points.length);
  }

  limits(points) {
    if (Array.isArray(this.range)) return this.range;
    let most = this.minimum;
    for (const point of points) {
      for (const pick of this.series) {
        const value = pick(point);
        if (value !== null) most = Math.max(most, Math.abs(value));
      }
    }
    const high = nice(most);
    return this.range === "symmetric" ? [-high, high] : [0, high];
  }
}

// The next of 1, 2, 4, 6, 8, 10 times a power of ten: steps that halve well, and rarely change.
function nice(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 4, 6, 8, 10].find((step) => step * power >= value * 0.999) * power;
}

export function short(value) {
  const size = Math.abs(value);
  const text = size >= 1e6 ? `${trim(value / 1e6)}M` : size >= 1e4 ? `${trim(value / 1e3)}k` : trim(value);
  return text.replace("-", "−");
}

const trim = (value) => String(Number(value.toPrecision(3)));

let colours = null;

function palette() {
  if (colours === null) {
    const style = getComputedStyle(document.documentElement);
    const of = (name) => style.getPropertyValue(name).trim();
    colours = { a: of("--series-a"), b: of("--series-b"), grid: of("--grid"), quiet: of("--quiet") };
  }
  return colours;
}

export function onPaletteChange(redraw) {
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    colours = null;
    redraw();
  });
}
