// The surface in the page: when it is drawn, and how pointer, keys and slider control it.

const TURN = 0.008; // radians per pixel of pointer motion
const STEP = Math.PI / 36; // radians per press of an arrow key
const ZOOM = 1.25; // factor per key press
const SHORT = 30; // CSS pixels below which the vertical line has no labels
const WHEEL = 0.0015; // logarithm of the factor per unit of the wheel

const data = JSON.parse(document.getElementById("surface-data").textContent);
const part = (name) => document.getElementById(`surface-${name}`);
const canvas = part("canvas"), slider = part("factor");
const view = new View(data, readGrid(data), canvas);
const pointers = new Map(); // positions of pressed pointers, by their id
let draw = null; // set while there is a context
let pending = false;

function redraw() {
  if (pending || !draw) return;
  pending = true;
  requestAnimationFrame(render);
}

function render() {
  pending = false;
  if (!draw) return;
  const sharp = [canvas.clientWidth, canvas.clientHeight].map((size) => Math.round(size * devicePixelRatio));
  if (canvas.width !== sharp[0] || canvas.height !== sharp[1]) [canvas.width, canvas.height] = sharp;
  const line = getComputedStyle(canvas).color.match(/[\d.]+/g).slice(0, 3);
  draw({ ...view.told, line: line.map((value) => value / 255) });
  placeLabels();
}

// Each axis has its letter at the end and its length next to its middle.
function labels({ left, right, near, far, lowest, highest, centre }) {
  return [
    ["x", [right, near, lowest], [left, near, lowest]],
    ["y", [left, far, lowest], [left, near, lowest]],
    ["z", [left, far, highest], [left, far, lowest]],
    ["width", [centre[0], near, lowest], [centre[0], centre[1], lowest]],
    ["depth", [left, centre[1], lowest], [centre[0], centre[1], lowest]],
    ["height", [left, far, centre[2]], centre],
  ];
}

// Place each label just beyond its point, away from another; hide labels that are invisible or overlap.
function placeLabels() {
  const [middle, level] = [canvas.clientWidth / 2, canvas.clientHeight / 2];
  const tall = view.box.size[2] * view.stretch * view.scale * Math.cos(view.elevation);
  for (const [name, place, other] of labels(view.box)) {
    const label = part(name), [x, y] = view.project(place), [fromX, fromY] = view.project(other);
    const length = Math.hypot(x - fromX, y - fromY) || 1;
    const [right, up] = [(x - fromX) / length, (y - fromY) / length];
    const half = [label.offsetWidth / 2, label.offsetHeight / 2];
    const beyond = 8 + Math.abs(right) * half[0] + Math.abs(up) * half[1];
    const left = clamp(x + beyond * right, half[0] + 4 - middle, middle - half[0] - 4);
    const move = `translate(${middle + left}px, ${level - y - beyond * up}px)`;
    label.style.transform = `${move} translate(-50%, -50%)`;
    const upright = name === "z" || name === "height";
    const seen = Math.abs(x) < middle && Math.abs(y) < level && (!upright || tall > SHORT);
    label.style.visibility = seen ? "visible" : "hidden";
  }
}

function setFactor(factor) {
  view.factor = factor;
  slider.value = factor;
  part("times").textContent = `${factor}\u00d7`;
  redraw();
}

// The position of a pointer on the canvas.
function placeOf(event) {
  const seen = canvas.getBoundingClientRect();
  return [event.clientX - seen.left - seen.width / 2, seen.top + seen.height / 2 - event.clientY];
}

// Show the coordinates of a point, or nothing.
function tell(found) {
  const words = [["x", data.unit], ["y", data.unit], ["z", data.unit_of_height]].map(([name, unit]) =>
    found ? `${name} ${found[name].toFixed(3).replace("-", "\u2212")} ${unit}` : "");
  part("readout").textContent = [...words, found?.filled ? "filled" : ""].join(" \u2003").trim();
}

function onMove(event) {
  const place = placeOf(event), before = pointers.get(event.pointerId);
  if (!before) {
    tell(view.pick(...place));
    return;
  }
  const other = [...pointers].find(([number]) => number !== event.pointerId)?.[1];
  pointers.set(event.pointerId, place);
  if (other) pinch(before, place, other);
  else view.orbit(TURN * (before[0] - place[0]), TURN * (before[1] - place[1]));
  redraw();
}

// One finger moves while another stays.
function pinch(before, place, other) {
  const apart = (one) => Math.hypot(one[0] - other[0], one[1] - other[1]) || 1;
  view.zoomAt((place[0] + other[0]) / 2, (place[1] + other[1]) / 2, apart(place) / apart(before));
  view.move((place[0] - before[0]) / 2, (place[1] - before[1]) / 2);
}

const KEYS = {
  ArrowLeft: () => view.orbit(STEP, 0),
  ArrowRight: () => view.orbit(-STEP, 0),
  ArrowUp: () => view.orbit(0, STEP),
  ArrowDown: () => view.orbit(0, -STEP),
  "+": () => view.zoomAt(0, 0, ZOOM),
  "=": () => view.zoomAt(0, 0, ZOOM), // the key of + without Shift
  "-": () => view.zoomAt(0, 0, 1 / ZOOM),
  Home: () => view.reset(),
};

function onKey(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || !(event.key in KEYS)) return;
  event.preventDefault();
  KEYS[event.key]();
  redraw();
}

// At the limits of the zoom, the wheel scrolls the page.
function onWheel(event) {
  if (!view.zoomAt(...placeOf(event), Math.exp(-WHEEL * event.deltaY))) return;
  event.preventDefault();
  redraw();
}

function listen() {
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, placeOf(event));
    tell(view.pick(...placeOf(event)));
  });
  canvas.addEventListener("pointermove", onMove);
  for (const ended of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(ended, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener("pointerleave", () => tell(null));
  canvas.addEventListener("dblclick", () => {
    view.reset();
    redraw();
  });
  canvas.addEventListener("wheel", onWheel, { passive: false });
  canvas.addEventListener("keydown", onKey);
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault(); // otherwise the context is never restored
    draw = null;
  });
  canvas.addEventListener("webglcontextrestored", start);
  slider.addEventListener("input", () => setFactor(Number(slider.value)));
  new ResizeObserver(redraw).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
}

// Set the constant texts: the legend, and the size of the field.
function explain() {
  const rgb = (colour) => `rgb(${colour.map((value) => Math.round(255 * value)).join(" ")})`;
  part("ramp").style.background = `linear-gradient(to right, ${data.colours.map(rgb).join(", ")})`;
  if (data.filled) part("filled").style.background = rgb(data.filled);
  ["width", "depth", "height"].forEach((name, k) => {
    const size = view.box.size[k], unit = k === 2 ? data.unit_of_height : data.unit;
    part(name).textContent = `${unit === "px" ? Math.round(size) : size.toPrecision(3)} ${unit}`;
  });
}

// Start, also after the context was lost. Without WebGL 2 the note in the page remains.
function start() {
  const gl = canvas.getContext("webgl2", { antialias: true, preserveDrawingBuffer: true });
  draw = gl && !gl.isContextLost() ? buildScene(gl, data, view.grid, view.box) : null;
  document.getElementById("surface").classList.toggle("drawn", draw !== null);
  redraw();
}

explain();
setFactor(data.factor);
listen();
start();
