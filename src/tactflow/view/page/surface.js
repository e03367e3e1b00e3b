// The height map as a shaded surface that the user can rotate: seen from the camera, indentations rise towards the
// viewer. Without WebGL, a shaded picture from above.

const START = { azimuth: 0.35, tilt: 0.95 };  // radians; tilt 0 is the view from above
const STEEPEST = 1.45;  // radians
const PER_PIXEL = 0.008;  // radians per pixel of pointer motion
const MARGIN = 1.08;  // width of the view relative to the gel
const LIGHT = unit([-0.45, -0.55, 0.7]);  // towards the lamp: x right, y down, z towards the viewer
const AMBIENT = 0.35;
const BELOW = 0.02;  // mm by which the surrounding gel is lowered, to avoid covering the mesh

// Five colours of viridis, from 0 to the top of the scale.
export const RAMP = ["#440154", "#3b528b", "#21918c", "#5ec962", "#fde725"];
const COLOURS = RAMP.map(channels);

const VERTEX = `
attribute vec2 place; attribute vec3 relief;
uniform mat3 view; uniform vec2 fit; uniform float rise;
varying float height; varying vec3 normal;
void main() {
  vec3 seen = view * vec3(place, relief.x * rise);
  height = relief.x;
  normal = view * vec3(-relief.yz * rise, 1.0);
  gl_Position = vec4(seen.x * fit.x, -seen.y * fit.y, -seen.z * 0.2, 1.0);
}`;
const FRAGMENT = `
precision mediump float;
uniform vec3 ramp[5]; uniform float top; uniform vec3 light;
varying float height; varying vec3 normal;
void main() {
  float level = clamp(height / top, 0.0, 1.0) * 4.0;
  vec3 colour = ramp[0];
  for (int i = 0; i < 4; i++) colour = mix(colour, ramp[i + 1], clamp(level - float(i), 0.0, 1.0));
  float lit = max(0.0, dot(normalize(normal), light)) / light.z;
  gl_FragColor = vec4(colour * mix(lit, 1.0, ${AMBIENT}), 1.0);
}`;

export class Surface {
  constructor(canvas) {
    // Without a graphics card, antialiasing would double the time of a frame to 20 ms.
    const gl = canvas.getContext("webgl", { alpha: false, antialias: false });
    this.canvas = canvas;
    this.painter = gl ? new Turning(gl) : new Flat(canvas.getContext("2d", { alpha: false }));
    this.turns = gl !== null;
    this.ratio = 0;
    this.colours = null;
    this.rise = 1;
    this.turned = { ...START };
    this.show(null, null, 1);
    canvas.addEventListener("webglcontextlost", (event) => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => {
      this.painter = new Turning(gl);
      this.draw();
    });
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

  // rise: magnification of the heights.
  choose(rise) {
    this.rise = rise;
    this.draw();
  }

  // Rotate by pixels of pointer motion; without arguments, reset the view.
  turn(dx, dy) {
    const { azimuth, tilt } = this.turned;
    this.turned = dx === undefined
      ? { ...START }
      : { azimuth: azimuth + dx * PER_PIXEL, tilt: Math.min(STEEPEST, Math.max(0, tilt - dy * PER_PIXEL)) };
    this.draw();
  }

  // header: of the frame. heights: of the cells, in steps; null without contact. top: height of the lightest
  // colour, mm.
  show(header, heights, top) {
    this.gel = header?.scale ? header.message.size.map((side, axis) => side * header.scale[axis]) : null;
    this.mesh = heights ? mesh(header, heights) : null;
    this.top = top;
    this.draw();
  }

  draw() {
    if (this.colours && this.ratio && this.canvas.width > 1) this.painter.draw(this);
  }
}

// Vertices: place (x right, y down) in mm from the centre of the gel, and relief (height and its slopes). The outermost
// ones surround the indentation and are at rest.
function mesh({ scale, surface: { box, size, step }, message }, heights) {
  const [columns, rows] = [size[0] + 2, size[1] + 2];
  const cell = [0, 1].map((axis) => (box[axis + 2] / size[axis]) * scale[axis]);
  const first = [0, 1].map((axis) => (box[axis] - message.size[axis] / 2) * scale[axis] - cell[axis] / 2);
  const place = new Float32Array(2 * columns * rows);
  const relief = new Float32Array(3 * columns * rows);
  const height = (c, r) => (c > 0 && r > 0 && c < columns - 1 && r < rows - 1 ? heights[(r - 1) * size[0] + c - 1] * step : 0);
  for (let r = 0, i = 0; r < rows; r++) {
    for (let c = 0; c < columns; c++, i++) {
      place[2 * i] = first[0] + c * cell[0];
      place[2 * i + 1] = first[1] + r * cell[1];
      relief[3 * i] = height(c, r);
      relief[3 * i + 1] = (height(c + 1, r) - height(c - 1, r)) / (2 * cell[0]);
      relief[3 * i + 2] = (height(c, r + 1) - height(c, r - 1)) / (2 * cell[1]);
    }
  }
  return { columns, rows, place, relief, box };
}

// With WebGL.
class Turning {
  constructor(gl) {
    this.gl = gl;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    gl.useProgram(program);
    gl.enable(gl.DEPTH_TEST);
    const uniform = (name) => gl.getUniformLocation(program, name);
    this.at = { view: uniform("view"), fit: uniform("fit"), rise: uniform("rise"), top: uniform("top") };
    gl.uniform3fv(uniform("ramp"), COLOURS.flat());
    gl.uniform3fv(uniform("light"), LIGHT);
    const buffer = (name, length) => {
      const location = gl.getAttribLocation(program, name);
      gl.enableVertexAttribArray(location);
      return { buffer: gl.createBuffer(), location, length };
    };
    this.place = buffer("place", 2);
    this.relief = buffer("relief", 3);
    this.corners = gl.createBuffer();
  }

  draw({ canvas, gel, mesh, rise, top, turned, colours }) {
    const { gl, at } = this;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...channels(colours.well), 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (!gel) return;
    // The diagonal of the gel fits at any rotation; tilting reduces its height.
    const pixels = Math.min(canvas.width, canvas.height / Math.max(0.55, Math.cos(turned.tilt))) / MARGIN;
    const size = 2 / Math.hypot(...gel);
    gl.uniformMatrix3fv(at.view, false, rotation(turned).map((value) => value * size));
    gl.uniform2f(at.fit, pixels / canvas.width, pixels / canvas.height);
    gl.uniform1f(at.rise, rise);
    gl.uniform1f(at.top, top);
    const [x, y] = [gel[0] / 2, gel[1] / 2];
    const around = { place: [-x, -y, x, -y, -x, y, x, y], relief: Array(4).fill([-BELOW, 0, 0]).flat() };
    this.fill({ columns: 2, rows: 2, place: new Float32Array(around.place), relief: new Float32Array(around.relief) });
    if (mesh) this.fill(mesh);
  }

  fill({ columns, rows, place, relief }) {
    const { gl } = this;
    for (const [{ buffer, location, length }, values] of [[this.place, place], [this.relief, relief]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, values, gl.DYNAMIC_DRAW);
      gl.vertexAttribPointer(location, length, gl.FLOAT, false, 0, 0);
    }
    const corners = triangles(columns, rows);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.corners);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, corners, gl.DYNAMIC_DRAW);
    gl.drawElements(gl.TRIANGLES, corners.length, gl.UNSIGNED_SHORT, 0);
  }
}

// Without WebGL: from above.
class Flat {
  constructor(context) {
    this.context = context;
    this.cells = new OffscreenCanvas(1, 1);
  }

  draw({ canvas, gel, mesh, rise, top, colours }) {
    const { context: c, cells } = this;
    c.fillStyle = colours.well;
    c.fillRect(0, 0, canvas.width, canvas.height);
    if (!gel) return;
    const pixels = Math.min(canvas.width / gel[0], canvas.height / gel[1]) / MARGIN;
    c.setTransform(pixels, 0, 0, pixels, canvas.width / 2, canvas.height / 2);
    c.fillStyle = RAMP[0];
    c.fillRect(-gel[0] / 2, -gel[1] / 2, ...gel);
    if (mesh) {
      const { columns, rows, place, relief } = mesh;
      Object.assign(cells, { width: columns, height: rows });
      const picture = new ImageData(columns, rows);
      for (let i = 0; i < columns * rows; i++) picture.data.set(shaded(relief.subarray(3 * i, 3 * i + 3), rise, top), 4 * i);
      cells.getContext("2d").putImageData(picture, 0, 0);
      const [dx, dy] = [place[2] - place[0], place[2 * columns + 1] - place[1]];
      c.drawImage(cells, place[0] - dx / 2, place[1] - dy / 2, columns * dx, rows * dy);
    }
    c.resetTransform();
  }
}

// Equivalent of the shaders for the view from above: red, green, blue, alpha, 0 to 255.
function shaded([height, across, down], rise, top) {
  const level = Math.min(Math.max(height / top, 0), 1) * 4;
  const below = Math.min(Math.floor(level), 3);
  const normal = unit([-across * rise, -down * rise, 1]);
  const lit = Math.max(0, normal.reduce((sum, part, i) => sum + part * LIGHT[i], 0)) / LIGHT[2];
  const light = 255 * (AMBIENT + (1 - AMBIENT) * lit);
  const colour = COLOURS[below].map((part, i) => light * (part + (level - below) * (COLOURS[below + 1][i] - part)));
  return [...colour.map((part) => Math.min(part, 255)), 255];
}

// Column-major matrix that rotates about z, then tilts back.
function rotation({ azimuth, tilt }) {
  const [sa, ca, st, ct] = [Math.sin(azimuth), Math.cos(azimuth), Math.sin(tilt), Math.cos(tilt)];
  return [ca, sa * ct, sa * st, -sa, ca * ct, ca * st, 0, -st, ct];
}

function triangles(columns, rows) {
  const corners = new Uint16Array(6 * (columns - 1) * (rows - 1));
  let n = 0;
  for (let r = 0; r < rows - 1; r++) {
    for (let c = 0; c < columns - 1; c++) {
      const a = r * columns + c;
      const b = a + columns;
      for (const corner of [a, b, a + 1, a + 1, b, b + 1]) corners[n++] = corner;
    }
  }
  return corners;
}

// A colour #rrggbb as red, green, blue, 0 to 1.
function channels(colour) {
  return [1, 3, 5].map((start) => parseInt(colour.slice(start, start + 2), 16) / 255);
}

function unit(vector) {
  const length = Math.hypot(...vector);
  return vector.map((part) => part / length);
}
