// Small linear algebra. Matrices are column-major Float32Arrays of 16, as WebGL wants them.
const Mat = {
  perspective(fovY, aspect, near, far) {
    const f = 1 / Math.tan(fovY / 2), d = near - far;
    return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / d, -1, 0, 0, 2 * far * near / d, 0]);
  },
  orthographic(half, near, far) {
    const d = near - far;
    return new Float32Array([1 / half, 0, 0, 0, 0, 1 / half, 0, 0, 0, 0, 2 / d, 0, 0, 0, (far + near) / d, 1]);
  },
  lookAt(eye, target, up) {
    const z = Vec.unit(Vec.minus(eye, target)), x = Vec.unit(Vec.cross(up, z)), y = Vec.cross(z, x);
    return new Float32Array([
      x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0,
      -Vec.dot(x, eye), -Vec.dot(y, eye), -Vec.dot(z, eye), 1]);
  },
  multiply(a, b) {
    const out = new Float32Array(16);
    for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) {
      let sum = 0;
      for (let k = 0; k < 4; k++) sum += a[4 * k + r] * b[4 * c + k];
      out[4 * c + r] = sum;
    }
    return out;
  },
  apply(m, p) {
    const out = [0, 0, 0, 0];
    for (let r = 0; r < 4; r++) out[r] = m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r];
    return out;
  },
};

const Vec = {
  minus: (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]],
  plus: (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]],
  dot: (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2],
  cross: (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]],
  length: a => Math.hypot(a[0], a[1], a[2]),
  unit(a) { const n = Vec.length(a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; },
};

const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// Rows of the rotation of a quaternion (x, y, z, w), written into out[at…at+8].
function rotationRows(x, y, z, w, out, at) {
  out[at] = 1 - 2 * (y * y + z * z); out[at + 1] = 2 * (x * y - z * w); out[at + 2] = 2 * (x * z + y * w);
  out[at + 3] = 2 * (x * y + z * w); out[at + 4] = 1 - 2 * (x * x + z * z); out[at + 5] = 2 * (y * z - x * w);
  out[at + 6] = 2 * (x * z - y * w); out[at + 7] = 2 * (y * z + x * w); out[at + 8] = 1 - 2 * (x * x + y * y);
}

// Calls act when the element's width or height has changed, outside of the layout that changed it.
function whenResized(element, act) {
  let width = -1, height = -1;
  new ResizeObserver(() => requestAnimationFrame(() => {
    if (element.clientWidth === width && element.clientHeight === height) return;
    [width, height] = [element.clientWidth, element.clientHeight];
    act();
  })).observe(element);
}
