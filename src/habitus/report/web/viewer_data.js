// The arrays that Python packed (report/shell.py), and the motion they hold.
const TYPES = { u1: Uint8Array, i1: Int8Array, u2: Uint16Array, i2: Int16Array, u4: Uint32Array, f4: Float32Array };
const MISSING = 65535;

class Arrays {
  constructor(contents, text, size) {
    const binary = atob(text), bytes = new Uint8Array(binary.length);
    for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
    this.contents = contents;
    this.buffer = inflate(bytes, size).buffer;
    for (const name of Object.keys(contents)) if (contents[name].steps) this.#addUp(name);
  }
  // From differences of rows, low bytes first and high bytes after them, to the rows.
  #addUp(name) {
    const { shape, start } = this.contents[name], values = this.get(name), width = values.length / Math.max(shape[0], 1);
    const bytes = values.BYTES_PER_ELEMENT, planes = new Uint8Array(this.buffer, start, bytes * values.length).slice();
    for (let i = 0; i < values.length; i++) {
      let step = planes[i];
      if (bytes === 2) step |= planes[values.length + i] << 8;
      values[i] = step + (i < width ? 0 : values[i - width]);
    }
  }
  has(name) { return name in this.contents; }
  shape(name) { return this.contents[name].shape; }
  get(name) {
    const { type, shape, start } = this.contents[name];
    return new TYPES[type](this.buffer, start, shape.reduce((a, b) => a * b, 1));
  }
  points(name) {
    const { low, step } = this.contents[name], raw = this.get(name), out = new Float32Array(raw.length);
    for (let i = 0; i < raw.length; i++) out[i] = raw[i] === MISSING ? NaN : low[i % 3] + step[i % 3] * raw[i];
    return out;
  }
}

// A stage's motion: forward kinematics at any (fractional) frame.
class Motion {
  constructor(facts, arrays, stage) {
    this.parents = facts.parents;
    this.rest = arrays.get('restJoints');
    this.frames = arrays.shape(`${stage}/root`)[0];
    this.quaternions = arrays.get(`${stage}/quaternions`);
    this.root = arrays.get(`${stage}/root`);
    this.joints = arrays.has(`${stage}/joints`) ? arrays.points(`${stage}/joints`) : null;
    this.morphWeights = arrays.get(`${stage}/morphWeights`);
    this.morphs = arrays.shape(`${stage}/morphWeights`)[1];
    this.morphUnit = arrays.contents[`${stage}/morphWeights`].unit;
    const count = this.parents.length;
    this.turns = new Float32Array(9 * count);
    this.local = new Float32Array(9);
    this.offset = [0, 0, 0];
  }
  // Fills pose.bones (J x 16: three rows of the skinning matrix, then the joint's place) and pose.weights.
  sample(frame, pose) {
    const i = clamp(Math.floor(frame), 0, this.frames - 1), k = Math.min(i + 1, this.frames - 1), u = frame - i;
    for (let j = 0; j < this.parents.length; j++) {
      this.#turn(j, i, k, u);
      this.#translate(j, i, k, u);
      this.#join(j, pose.bones);
    }
    const { morphs, morphWeights: w } = this;
    for (let m = 0; m < morphs; m++) pose.weights[m] = this.morphUnit * ((1 - u) * w[i * morphs + m] + u * w[k * morphs + m]);
    pose.weights.fill(0, morphs);
  }
  rootAt(frame) {
    const i = clamp(Math.floor(frame), 0, this.frames - 1), k = Math.min(i + 1, this.frames - 1), u = frame - i;
    return [0, 1, 2].map(c => (1 - u) * this.root[3 * i + c] + u * this.root[3 * k + c]);
  }
  // Where the body faces (its +z), as an angle about the world's +y.
  headingAt(frame) {
    const at = 4 * this.parents.length * clamp(Math.round(frame), 0, this.frames - 1), rows = new Float32Array(9);
    const [x, y, z, w] = Array.from(this.quaternions.subarray(at, at + 4), v => v / 32767);
    rotationRows(x, y, z, w, rows, 0);
    return Math.hypot(rows[2], rows[8]) > 0.3 ? Math.atan2(rows[2], rows[8]) : 0;
  }
  #turn(j, i, k, u) {
    const q = this.quaternions, a = 4 * (i * this.parents.length + j), b = 4 * (k * this.parents.length + j);
    const v = [0, 1, 2, 3].map(c => (1 - u) * q[a + c] + u * q[b + c]), n = Math.hypot(...v);
    rotationRows(v[0] / n, v[1] / n, v[2] / n, v[3] / n, this.local, 0);
  }
  #translate(j, i, k, u) {
    const p = this.parents[j], o = this.offset, count = this.parents.length - 1;
    for (let c = 0; c < 3; c++) {
      if (p < 0) o[c] = (1 - u) * this.root[3 * i + c] + u * this.root[3 * k + c];
      else if (this.joints) {
        o[c] = (1 - u) * this.joints[3 * (i * count + j - 1) + c] + u * this.joints[3 * (k * count + j - 1) + c];
      } else o[c] = this.rest[3 * j + c] - this.rest[3 * p + c];
    }
  }
  #join(j, bones) {
    const p = this.parents[j], l = this.local, o = this.offset, t = this.turns;
    for (let r = 0; r < 3; r++) {
      let place = o[r];
      if (p < 0) for (let c = 0; c < 3; c++) t[9 * j + 3 * r + c] = l[3 * r + c];
      else {
        const x = t[9 * p + 3 * r], y = t[9 * p + 3 * r + 1], z = t[9 * p + 3 * r + 2];
        for (let c = 0; c < 3; c++) t[9 * j + 3 * r + c] = x * l[c] + y * l[3 + c] + z * l[6 + c];
        place = bones[16 * p + 12 + r] + x * o[0] + y * o[1] + z * o[2];
      }
      bones[16 * j + 12 + r] = place;
      let moved = place;
      for (let c = 0; c < 3; c++) {
        bones[16 * j + 4 * r + c] = t[9 * j + 3 * r + c];
        moved -= t[9 * j + 3 * r + c] * this.rest[3 * j + c];
      }
      bones[16 * j + 4 * r + 3] = moved;
    }
  }
}

// The body at rest, for the view of where the markers sit.
function restPose(rest, pose) {
  pose.bones.fill(0);
  for (let j = 0; j < rest.length / 3; j++) {
    for (let r = 0; r < 3; r++) { pose.bones[16 * j + 5 * r] = 1; pose.bones[16 * j + 12 + r] = rest[3 * j + r]; }
  }
  pose.weights.fill(0);
}

// Area-weighted vertex normals.
function vertexNormals(vertices, faces) {
  const normals = new Float32Array(vertices.length);
  for (let f = 0; f < faces.length; f += 3) {
    const [a, b, c] = [0, 1, 2].map(k => vertices.subarray(3 * faces[f + k], 3 * faces[f + k] + 3));
    const n = Vec.cross(Vec.minus(b, a), Vec.minus(c, a));
    for (let k = 0; k < 3; k++) for (let d = 0; d < 3; d++) normals[3 * faces[f + k] + d] += n[d];
  }
  for (let v = 0; v < normals.length; v += 3) {
    const n = Math.hypot(normals[v], normals[v + 1], normals[v + 2]) || 1;
    for (let d = 0; d < 3; d++) normals[v + d] /= n;
  }
  return normals;
}
