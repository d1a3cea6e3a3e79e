// One body with a colour for each vertex, turned by dragging. The page says in data-ready when it has drawn once.
window.addEventListener('error', e => { document.body.dataset.errors = `${document.body.dataset.errors || ''}${e.message}; `; });
const report = JSON.parse(document.getElementById('report-data').textContent);
const packed = atob(document.getElementById('report-arrays').textContent.trim());
const bytes = Uint8Array.from(packed, letter => letter.charCodeAt(0));
const store = inflate(bytes, report.bytes).buffer;
const TYPES = { u1: Uint8Array, u2: Uint16Array, u4: Uint32Array, f4: Float32Array };
const array = name => {
  const { type, shape, start } = report.arrays[name];
  return new TYPES[type](store, start, shape.reduce((a, b) => a * b, 1));
};
const canvas = document.getElementById('body'), gl = canvas.getContext('webgl2', { antialias: true });
const view = { yaw: 0.4, pitch: 0.08, near: 1, colours: true, spin: !matchMedia('(prefers-reduced-motion: reduce)').matches };

function program(vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

function normals(points, faces) {
  const out = new Float32Array(points.length);
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [3 * faces[f], 3 * faces[f + 1], 3 * faces[f + 2]], e = [], g = [];
    for (let k = 0; k < 3; k++) { e.push(points[b + k] - points[a + k]); g.push(points[c + k] - points[a + k]); }
    const n = [e[1] * g[2] - e[2] * g[1], e[2] * g[0] - e[0] * g[2], e[0] * g[1] - e[1] * g[0]];
    for (const corner of [a, b, c]) for (let k = 0; k < 3; k++) out[corner + k] += n[k];
  }
  return out;
}

function scene() {
  const points = array('vertices'), faces = array('faces'), colours = array('colours');
  const shader = program(
    `#version 300 es
    in vec3 place; in vec3 normal; in vec4 colour; uniform mat3 turn; uniform vec4 fit; uniform float shown; out vec3 n; out vec3 c;
    void main() {
      vec3 p = turn * (place - vec3(0.0, fit.z, 0.0));
      gl_Position = vec4(p.x * fit.x, p.y * fit.y, -p.z * 0.2, 1.0);
      n = turn * normalize(normal); c = mix(vec3(0.62, 0.60, 0.57), colour.rgb, shown);
    }`,
    `#version 300 es
    precision highp float; in vec3 n; in vec3 c; out vec4 pixel;
    void main() {
      vec3 m = normalize(n);
      float light = 0.52 + 0.34 * max(dot(m, normalize(vec3(0.35, 0.5, 0.8))), 0.0) + 0.14 * m.y;
      pixel = vec4(pow(pow(c, vec3(2.2)) * light * 1.25, vec3(1.0 / 2.2)), 1.0);
    }`);
  gl.useProgram(shader);
  const feed = (name, data, size, type, norm) => {
    const at = gl.getAttribLocation(shader, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, size, type, norm, 0, 0);
  };
  feed('place', points, 3, gl.FLOAT, false);
  feed('normal', normals(points, faces), 3, gl.FLOAT, false);
  feed('colour', colours, 4, gl.UNSIGNED_BYTE, true);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
  gl.enable(gl.DEPTH_TEST);
  const place = name => gl.getUniformLocation(shader, name);
  return { count: faces.length, type: faces instanceof Uint32Array ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT,
    turn: place('turn'), fit: place('fit'), shown: place('shown') };
}

function draw(drawn) {
  const ratio = Math.min(devicePixelRatio || 1, 2), width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  gl.viewport(0, 0, width, height);
  gl.clearColor(0, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  const [sy, cy, sp, cp] = [Math.sin(view.yaw), Math.cos(view.yaw), Math.sin(view.pitch), Math.cos(view.pitch)];
  gl.uniformMatrix3fv(drawn.turn, false, [cy, sp * sy, -cp * sy, 0, cp, sp, sy, -sp * cy, cp * cy]);
  const scale = 1.8 / report.height * view.near;
  gl.uniform4f(drawn.fit, scale * height / width, scale, report.height / 2, 0);
  gl.uniform1f(drawn.shown, view.colours ? 1 : 0);
  gl.drawElements(gl.TRIANGLES, drawn.count, drawn.type, 0);
}

function listen(redraw) {
  let from = null;
  canvas.addEventListener('pointerdown', e => { from = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); stop(); });
  canvas.addEventListener('pointermove', e => {
    if (!from) return;
    view.yaw += (e.clientX - from[0]) * 0.008;
    view.pitch = Math.max(-1.4, Math.min(1.4, view.pitch + (e.clientY - from[1]) * 0.008));
    from = [e.clientX, e.clientY];
    redraw();
  });
  for (const end of ['pointerup', 'pointercancel']) canvas.addEventListener(end, () => { from = null; });
  canvas.addEventListener('wheel', e => { e.preventDefault(); view.near = Math.max(0.6, Math.min(6, view.near * Math.exp(-e.deltaY * 0.001))); redraw(); }, { passive: false });
  canvas.addEventListener('keydown', e => { const by = { ArrowLeft: -0.1, ArrowRight: 0.1 }[e.key]; if (by) { stop(); view.yaw += by; redraw(); } });
  const toggle = (id, name) => {
    const button = document.getElementById(id);
    button.setAttribute('aria-pressed', view[name]);
    button.addEventListener('click', () => { view[name] = !view[name]; button.setAttribute('aria-pressed', view[name]); redraw(); });
  };
  toggle('coloured', 'colours');
  toggle('spin', 'spin');
  function stop() { view.spin = false; document.getElementById('spin').setAttribute('aria-pressed', false); }
}

if (gl) {
  const drawn = scene();
  const redraw = () => draw(drawn);
  listen(redraw);
  addEventListener('resize', redraw);
  const tick = () => { if (view.spin) { view.yaw += 0.008; redraw(); } requestAnimationFrame(tick); };
  redraw();
  requestAnimationFrame(tick);
} else {
  document.getElementById('hint').textContent = 'This browser cannot draw in 3D; body.glb holds the body.';
}
document.body.dataset.ready = 'yes';
