// The view of the surface: positions on the canvas, and the point under the pointer.
// Positions on the canvas are in CSS pixels from its centre, y up.

const HOME = { azimuth: -Math.PI / 6, elevation: Math.PI / 5, zoom: 1, shift: [0, 0] };
const LOWEST = 0.1, UPRIGHT = Math.PI / 2; // limits of the elevation
const CLOSEST = 40; // largest zoom
const MARGIN = 34; // around the surface, for its labels

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

// The field that contains the surface.
function boxOf({ x, y, lowest, highest }) {
  const [left, right, near, far] = [x[0], x.at(-1), y.at(-1), y[0]];
  const size = [right - left, far - near, highest - lowest];
  const centre = [(left + right) / 2, (near + far) / 2, (lowest + highest) / 2];
  return { left, right, near, far, lowest, highest, size, centre };
}

class View {
  constructor(data, grid, canvas) {
    Object.assign(this, { grid, canvas, box: boxOf(data), unit: data.stretch, factor: data.factor });
    this.reset();
  }

  reset() {
    Object.assign(this, HOME);
  }

  // Length of a millimetre of height, in the unit of x and y.
  get stretch() {
    return this.unit * this.factor;
  }

  // CSS pixels per unit of x and y: at zoom 1 everything fits, from any side.
  get scale() {
    const flat = Math.hypot(this.box.size[0], this.box.size[1]), tall = this.box.size[2] * this.stretch;
    const upwards = flat * Math.sin(this.elevation) + tall * Math.cos(this.elevation);
    const [wide, high] = [this.canvas.clientWidth - 2 * MARGIN, this.canvas.clientHeight - 2 * MARGIN];
    return this.zoom * Math.max(Math.min(wide / flat, high / upwards), 1e-6);
  }

  // Directions to the right, upwards and towards the eye, in the surface's x, y and z.
  get directions() {
    const [ca, sa] = [Math.cos(this.azimuth), Math.sin(this.azimuth)];
    const [ce, se] = [Math.cos(this.elevation), Math.sin(this.elevation)];
    return [[ca, sa, 0], [-sa * se, ca * se, ce], [sa * ce, -ca * ce, se]];
  }

  // The parameters of the scene.
  get told() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    return {
      turn: this.directions,
      stretch: this.stretch,
      scale: [(2 * this.scale) / width, (2 * this.scale) / height],
      shift: [(2 * this.shift[0]) / width, (2 * this.shift[1]) / height],
      depth: 1.9 / Math.hypot(this.box.size[0], this.box.size[1], this.box.size[2] * this.stretch),
    };
  }

  // The position on the canvas of a point given in the surface's x, y and z.
  project(point) {
    const seen = point.map((value, k) => (value - this.box.centre[k]) * (k === 2 ? this.stretch : 1));
    const along = (direction) => direction.reduce((sum, value, k) => sum + value * seen[k], 0);
    return this.directions.slice(0, 2).map((one, k) => this.scale * along(one) + this.shift[k]);
  }

  // The point of the surface visible at a position on the canvas, or null.
  pick(x, y) {
    const [right, up, eye] = this.directions, { centre, lowest, highest } = this.box;
    const [a, b] = [(x - this.shift[0]) / this.scale, (y - this.shift[1]) / this.scale];
    const [px, py, pz] = right.map((value, k) => a * value + b * up[k]);
    const onPlane = (height) => {
      const towards = ((height - centre[2]) * this.stretch - pz) / eye[2];
      return [centre[0] + px + towards * eye[0], centre[1] + py + towards * eye[1]];
    };
    return meet(this.grid, onPlane(highest), onPlane(lowest), lowest, highest);
  }

  orbit(azimuth, elevation) {
    this.azimuth += azimuth;
    this.elevation = clamp(this.elevation + elevation, LOWEST, UPRIGHT);
  }

  // Move the picture, but keep part of it visible.
  move(x, y) {
    const room = [this.canvas.clientWidth, this.canvas.clientHeight].map((size) => ((this.zoom - 1) * size) / 2);
    this.shift = [x, y].map((by, k) => clamp(this.shift[k] + by, -room[k], room[k]));
  }

  // Zoom about a position on the canvas; return whether anything changed.
  zoomAt(x, y, times) {
    const before = this.zoom;
    this.zoom = clamp(before * times, 1, CLOSEST);
    const more = this.zoom / before - 1;
    this.move(more * (this.shift[0] - x), more * (this.shift[1] - y));
    return more !== 0;
  }
}
