// Drawing with WebGL: the shaded surface, coloured by height, and the outline of its field.

const VERTEX = `#version 300 es
  in vec3 place;
  in vec2 slope;
  in float kind;  // 0 measured, 1 filled, 2 a line
  uniform mat3 turn;  // to the right, upwards and towards the eye
  uniform vec3 centre, stretch;
  uniform vec2 scale, shift;
  uniform float depth;
  out vec3 facing;
  out float height, what;
  void main() {
    vec3 seen = turn * ((place - centre) * stretch);
    gl_Position = vec4(seen.xy * scale + shift, -seen.z * depth, 1.0);
    facing = turn * vec3(-stretch.z * slope, 1.0);
    height = place.z;
    what = kind;
  }`;

const FRAGMENT = `#version 300 es
  precision highp float;
  in vec3 facing;
  in float height, what;
  uniform vec3 colours[16], filled, line;
  uniform vec2 shown;
  out vec4 colour;
  const vec3 LAMP = normalize(vec3(-0.45, 0.6, 0.66));
  vec3 byHeight() {
    float level = 15.0 * clamp((height - shown.x) / max(shown.y - shown.x, 1e-9), 0.0, 1.0);
    int stop = int(min(level, 14.0));
    return mix(colours[stop], colours[stop + 1], level - float(stop));
  }
  void main() {
    float toLamp = max(dot(normalize(facing), LAMP), 0.0);
    vec3 lit = (what > 0.5 ? filled : byHeight()) * (0.4 + 0.7 * toLamp) + 0.12 * pow(toLamp, 24.0);
    colour = vec4(what > 1.5 ? line : lit, 1.0);
  }`;

function compile(gl, kind, source) {
  const shader = gl.createShader(kind);
  gl.shaderSource(shader, source);
  gl.compileShader(shader);
  return shader;
}

function link(gl) {
  const program = gl.createProgram();
  gl.attachShader(program, compile(gl, gl.VERTEX_SHADER, VERTEX));
  gl.attachShader(program, compile(gl, gl.FRAGMENT_SHADER, FRAGMENT));
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    throw new Error(gl.getProgramInfoLog(program));
  }
  return program;
}

// Upload vertices of six numbers and the indices of the shapes to the graphics card.
function upload(gl, program, values, indices) {
  const shape = gl.createVertexArray();
  gl.bindVertexArray(shape);
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, values, gl.STATIC_DRAW);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
  for (const [name, size, first] of [["place", 3, 0], ["slope", 2, 3], ["kind", 1, 5]]) {
    const where = gl.getAttribLocation(program, name);
    gl.enableVertexAttribArray(where);
    gl.vertexAttribPointer(where, size, gl.FLOAT, false, 24, 4 * first);
  }
  return shape;
}

// The outline of the field at the lowest height, and a vertical line at its far left corner.
function outline({ left, right, near, far, lowest, highest }) {
  const corners = [[left, near], [right, near], [right, far], [left, far]];
  const points = [...corners.map((corner) => [...corner, lowest]), [left, far, highest]];
  const values = new Float32Array(points.flatMap((point) => [...point, 0, 0, 2]));
  return { values, indices: new Uint32Array([0, 1, 1, 2, 2, 3, 3, 0, 3, 4]) };
}

// Return a function that draws the scene for a view.
function buildScene(gl, data, grid, box) {
  const program = link(gl);
  const at = (name) => gl.getUniformLocation(program, name);
  const faces = triangles(grid);
  const lines = outline(box);
  const surface = upload(gl, program, vertices(grid), faces);
  const frame = upload(gl, program, lines.values, lines.indices);
  gl.useProgram(program);
  gl.enable(gl.DEPTH_TEST);
  gl.uniform3fv(at("colours"), data.colours.flat());
  gl.uniform3fv(at("filled"), data.filled ?? [0, 0, 0]);
  gl.uniform2fv(at("shown"), data.shown);
  gl.uniform3fv(at("centre"), box.centre);
  return ({ turn, stretch, scale, shift, depth, line }) => {
    gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.uniformMatrix3fv(at("turn"), true, turn.flat());
    gl.uniform3fv(at("stretch"), [1, 1, stretch]);
    gl.uniform2fv(at("scale"), scale);
    gl.uniform2fv(at("shift"), shift);
    gl.uniform1f(at("depth"), depth);
    gl.uniform3fv(at("line"), line);
    gl.bindVertexArray(surface);
    gl.drawElements(gl.TRIANGLES, faces.length, gl.UNSIGNED_INT, 0);
    gl.bindVertexArray(frame);
    gl.drawElements(gl.LINES, lines.indices.length, gl.UNSIGNED_INT, 0);
  };
}
