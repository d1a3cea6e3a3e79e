// A body that stands still: one look at a time, a surface or a cloud of points, turned by dragging; over it another cloud.
// The page says in data-ready when it has drawn once.
const report = JSON.parse(document.getElementById('report-data').textContent), canvas = document.getElementById('body');
const arrays = new Arrays(report.arrays, document.getElementById('report-arrays').textContent.trim(), report.bytes);
const gl = canvas.getContext('webgl2', { antialias: true, preserveDrawingBuffer: true });
const calm = matchMedia('(prefers-reduced-motion: reduce)').matches;
const START = { yaw: 0.4 - report.facing, pitch: 0.08, near: 1, right: 0, up: 0 };
const view = { ...START, look: 0, over: false, spin: !calm };

const VERTEX = `#version 300 es
in vec3 place; in vec3 normal; in vec4 colour; in vec4 hatched;
uniform mat3 turn; uniform vec3 middle; uniform vec4 fit; uniform vec3 skin; uniform float tinted; uniform float wide; uniform float lift; uniform float deep;
out vec3 n; out vec3 c; out vec2 h;
void main() {
  vec3 p = turn * (place - middle);
  gl_Position = vec4(p.x * fit.x + fit.z, p.y * fit.y + fit.w, -p.z * deep - lift, 1.0);
  gl_PointSize = wide; n = turn * normal; c = mix(skin, colour.rgb, tinted); h = hatched.xy;
}`;
const FRAGMENT = `#version 300 es
precision highp float; in vec3 n; in vec3 c; in vec2 h; uniform float wide; uniform float sided; uniform float stripe; out vec4 pixel;
float line(float along) { return 1.0 - smoothstep(0.26, 0.5, abs(fract(along / stripe) - 0.5) * 2.0); }
void main() {
  if (wide > 0.0 && length(gl_PointCoord - 0.5) > 0.5) discard;
  vec3 m = normalize(n);
  if (sided > 0.0 && m.z < 0.0) discard;
  float light = 0.52 + 0.34 * max(dot(m, normalize(vec3(0.35, 0.5, 0.8))), 0.0) + 0.14 * m.y;
  float both = step(0.5, h.y), lines = max(max(step(0.5, h.x), both) * line(gl_FragCoord.x - gl_FragCoord.y), both * line(gl_FragCoord.x + gl_FragCoord.y));
  vec3 own = mix(c, vec3(0.56, 0.36, 0.84), 0.85 * lines);
  pixel = vec4(pow(pow(own, vec3(2.2)) * light * 1.25, vec3(1.0 / 2.2)), 1.0);
}`;

function compiled() {
  const made = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  gl.useProgram(made);
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
  for (let i = 0; i < out.length; i += 3) {
    const long = Math.hypot(out[i], out[i + 1], out[i + 2]) || 1;
    for (let k = 0; k < 3; k++) out[i + k] /= long;
  }
  return out;
}

// A look as the graphics card holds it.
function loaded(shader, look) {
  const points = arrays.points(look.points), faces = look.faces && arrays.get(look.faces);
  const state = gl.createVertexArray();
  gl.bindVertexArray(state);
  const feed = (name, data, size, type, norm) => {
    const at = gl.getAttribLocation(shader, name);
    gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, size, type, norm, size === 4 ? 4 : 0, 0);
  };
  feed('place', points, 3, gl.FLOAT, false);
  if (look.normals) feed('normal', arrays.get(look.normals), 4, gl.BYTE, true);
  else feed('normal', normals(points, faces), 3, gl.FLOAT, false);
  if (look.hatched) feed('hatched', arrays.get(look.hatched), 4, gl.UNSIGNED_BYTE, true);
  const tinted = Boolean(look.colours);
  if (tinted) feed('colour', arrays.get(look.colours), 4, gl.UNSIGNED_BYTE, true);
  if (faces) {
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
  }
  const type = faces instanceof Uint32Array ? gl.UNSIGNED_INT : gl.UNSIGNED_SHORT;
  return { state, tinted, type, faces: faces && faces.length, points: points.length / 3, spacing: look.spacing };
}

function scene() {
  const shader = compiled(), place = Object.fromEntries(['turn', 'middle', 'fit', 'skin', 'tinted', 'wide', 'lift', 'deep', 'sided', 'stripe'].map(n => [n, gl.getUniformLocation(shader, n)]));
  gl.enable(gl.DEPTH_TEST);
  return { place, looks: report.looks.map(look => loaded(shader, look)), over: report.over && loaded(shader, report.over) };
}

function show({ place }, one, skin, scale, lift) {
  gl.bindVertexArray(one.state);
  const wide = one.faces ? 0 : Math.max(1.5, one.spacing * scale * canvas.height * (lift ? 0.35 : 1.3));
  gl.uniform3fv(place.skin, skin);
  for (const [name, value] of [['tinted', one.tinted ? 1 : 0], ['wide', wide], ['lift', lift], ['sided', one.faces ? 0 : 1]]) gl.uniform1f(place[name], value);
  if (one.faces) gl.drawElements(gl.TRIANGLES, one.faces, one.type, 0);
  else gl.drawArrays(gl.POINTS, 0, one.points);
}

function draw(drawn) {
  const ratio = Math.min(devicePixelRatio || 1, 2), width = Math.round(canvas.clientWidth * ratio), height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; }
  gl.viewport(0, 0, width, height);
  gl.clearColor(0, 0, 0, 0);
  gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  const [sy, cy, sp, cp] = [Math.sin(view.yaw), Math.cos(view.yaw), Math.sin(view.pitch), Math.cos(view.pitch)];
  gl.uniformMatrix3fv(drawn.place.turn, false, [cy, sp * sy, -cp * sy, 0, cp, sp, sy, -sp * cy, cp * cy]);
  const frame = report.looks[view.look], scale = 1.84 / frame.size * view.near;
  gl.uniform3fv(drawn.place.middle, frame.middle);
  gl.uniform1f(drawn.place.stripe, 9 * ratio);
  gl.uniform1f(drawn.place.deep, 0.36 / Math.max(frame.size, 1.8));
  gl.uniform4f(drawn.place.fit, scale * height / width, scale, view.right, view.up);
  show(drawn, drawn.looks[view.look], [0.62, 0.60, 0.57], scale / 2, 0);
  if (view.over) show(drawn, drawn.over, [0.85, 0.35, 0.05], scale / 2, 0.001);
}

// The point under the pointer stays there while all around it grows.
function zoom(e) {
  const box = canvas.getBoundingClientRect(), near = Math.max(0.6, Math.min(16, view.near * Math.exp(-e.deltaY * 0.001))), by = near / view.near;
  const x = 2 * (e.clientX - box.left) / box.width - 1, y = 1 - 2 * (e.clientY - box.top) / box.height;
  Object.assign(view, { near, right: x + (view.right - x) * by, up: y + (view.up - y) * by });
}

function choose(k) {
  view.look = k;
  for (const b of document.querySelectorAll('[data-look]')) b.setAttribute('aria-pressed', Number(b.dataset.look) === k);
  for (const p of document.querySelectorAll('[data-caption]')) p.hidden = Number(p.dataset.caption) !== k;
}

function listen(redraw) {
  let from = null;
  const press = (id, name) => document.getElementById(id)?.setAttribute('aria-pressed', view[name]);
  const stop = () => { view.spin = false; press('spin', 'spin'); };
  canvas.addEventListener('pointerdown', e => { from = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); stop(); });
  canvas.addEventListener('pointermove', e => {
    if (!from) return;
    view.yaw += (e.clientX - from[0]) * 0.008;
    view.pitch = Math.max(-1.4, Math.min(1.4, view.pitch + (e.clientY - from[1]) * 0.008));
    from = [e.clientX, e.clientY];
    redraw();
  });
  for (const end of ['pointerup', 'pointercancel']) canvas.addEventListener(end, () => { from = null; });
  canvas.addEventListener('wheel', e => { e.preventDefault(); stop(); zoom(e); redraw(); }, { passive: false });
  canvas.addEventListener('dblclick', () => { Object.assign(view, START); redraw(); });
  canvas.addEventListener('keydown', e => { const by = { ArrowLeft: -0.1, ArrowRight: 0.1 }[e.key]; if (by) { stop(); view.yaw += by; redraw(); } });
  for (const b of document.querySelectorAll('[data-look]')) b.addEventListener('click', () => { choose(Number(b.dataset.look)); redraw(); });
  for (const name of ['over', 'spin']) {
    press(name, name);
    document.getElementById(name)?.addEventListener('click', () => { view[name] = !view[name]; press(name, name); redraw(); });
  }
}

// A link may name a look and what lies over it: #look=2&over=yes&yaw=1.5&still=yes
function follow() {
  const wish = new URLSearchParams(location.hash.slice(1));
  if (wish.has('look')) choose(Math.min(report.looks.length - 1, Math.max(0, Number(wish.get('look')) || 0)));
  if (wish.has('over')) view.over = Boolean(report.over);
  if (wish.has('yaw')) view.yaw = Number(wish.get('yaw')) - report.facing;
  if (wish.has('still')) view.spin = false;
}

follow();
if (gl) {
  const drawn = scene(), redraw = () => draw(drawn);
  listen(redraw);
  addEventListener('resize', redraw);
  document.addEventListener('theme', redraw);
  const tick = () => { if (view.spin) { view.yaw += 0.008; redraw(); } requestAnimationFrame(tick); };
  redraw();
  requestAnimationFrame(tick);
  body.dataset.webgl = 'yes';
} else {
  body.dataset.webgl = 'no';
  document.getElementById('hint').textContent = 'This browser cannot draw in 3D; the files below hold the body.';
}
body.dataset.ready = 'yes';
