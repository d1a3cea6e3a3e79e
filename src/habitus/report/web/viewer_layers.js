// What is drawn over the body: markers, error lines, skeleton, and names on a flat canvas above.
const NAME_FONT = '600 11px -apple-system, "Segoe UI", Roboto, "Helvetica Neue", "Noto Sans", "Liberation Sans", Arial, sans-serif';

const TRAIL = 1, TRAIL_STEPS = 30; // seconds, and pieces a second

class Layers {
  constructor(report, arrays, scene, overlay) {
    Object.assign(this, { report, scene, overlay });
    this.labels = report.labels;
    this.observed = arrays.points('observed');
    this.predicted = Object.fromEntries(report.scene.stages.map(s => [s, arrays.points(`${s}/predicted`)]));
    this.weights = arrays.get('markerWeights');
    this.latent = arrays.get('latent');
    this.skin = arrays.get('skin');
    this.skinDistance = arrays.get('skinDistance');
    this.a = [0, 0, 0];
    this.guessed = arrays.has('guessed') ? { levels: arrays.get('guessed'), frames: arrays.get('guessedFrames') } : null;
    this.tapes = [];
    let from = 0;
    for (const { name, points } of report.scene.tapes) {
      this.tapes.push({ name, points: arrays.get('tapes').subarray(3 * from, 3 * (from += points)) });
    }
  }
  at(points, frame, marker) {
    const count = this.labels.length, last = points.length / 3 / count - 1;
    const i = clamp(Math.floor(frame), 0, last), k = Math.min(i + 1, last), u = frame - i, out = [0, 0, 0];
    for (let c = 0; c < 3; c++) {
      const from = points[3 * (i * count + marker) + c], to = points[3 * (k * count + marker) + c];
      out[c] = u < 1e-6 || !(to === to) ? from : (1 - u) * from + u * to;
    }
    return out[0] === out[0] ? out : null;
  }
  weightAt(frame, marker) {
    const count = this.labels.length, last = this.weights.length / count - 1;
    return this.weights[clamp(Math.round(frame), 0, last) * count + marker] / 255;
  }
  // Marker positions of the moment: [{label index, observed, predicted, error (mm)}]
  moment(state) {
    return this.labels.map((_, m) => {
      if (state.view === 'placement') return { m, latent: [...this.latent.subarray(3 * m, 3 * m + 3)], skin: [...this.skin.subarray(3 * m, 3 * m + 3)] };
      const observed = this.at(this.observed, state.frame, m), predicted = this.at(this.predicted[state.stage], state.frame, m);
      const error = observed && predicted ? 1000 * Vec.length(Vec.minus(observed, predicted)) : null;
      return { m, observed, predicted, error };
    });
  }
  // more: to what other layers have filled in
  fill(state, moment, pose, colors, more = false) {
    const { markers, lines, bones, joints } = this.scene;
    if (!more) for (const set of [markers, lines, bones, joints]) set.clear();
    for (const item of moment) state.view === 'placement' ? this.#placed(item, colors) : this.#seen(item, state, colors);
    if (state.view === 'placement') this.#laid(state, colors);
    if (state.layers.skeleton) this.#skeleton(pose, colors);
    if (state.layers.trails && state.view === 'motion') this.#trails(state, colors);
  }
  // Each joint's mark in a pose, as the shaders read it: how much of a guess its segment is in a frame of the capture.
  markGuessed(pose, frame, on) {
    const joints = pose.bones.length / 16, at = this.guessed && on ? lastNotAfter(this.guessed.frames, frame) : -1;
    for (let j = 0; j < joints; j++) pose.bones[16 * j + 15] = at < 0 ? 0 : this.guessed.levels[at * joints + j] / 255;
  }
  #laid({ layers, tape }, colors) {
    for (const { name, points } of this.tapes) {
      if (!layers.tapes && name !== tape) continue;
      const color = [...(name === tape ? colors.error : colors.accent), 1], count = points.length / 3, wide = (name === tape ? 3.4 : 2.2) * this.#dpr();
      const at = k => [...points.subarray(3 * (k % count), 3 * (k % count) + 3)];
      for (let k = 0; k < count; k++) this.scene.lines.add(at(k), at(k + 1), color, wide);
    }
  }
  // Names and lengths of the tapes that are shown, once for both sides: [{text, x, y}] in CSS pixels, at the right end in the picture.
  tapeNames({ layers, tape, view }, viewProjection, measured) {
    if (view !== 'placement') return [];
    const width = this.overlay.clientWidth, height = this.overlay.clientHeight;
    const found = new Map();
    for (const { name, points } of this.tapes.filter(one => layers.tapes || one.name === tape)) {
      let best = found.get(name) ?? { x: -1, y: 0 };
      for (let k = 0; k < points.length; k += 3) {
        const [x, y, , w] = Mat.apply(viewProjection, points.subarray(k, k + 3)), right = (x / w + 1) * width / 2;
        if (w > 0 && right > best.x) best = { x: right, y: (1 - y / w) * height / 2 };
      }
      found.set(name, best);
    }
    return [...found].map(([name, at]) => ({ ...at, text: `${name.replace('_circumference_m', '').replaceAll('_', ' ')} ${measured(name)}` }));
  }
  // Where markers were in the last second, fading; of the chosen one, the second to come as well.
  #trails({ frame, selected }, colors) {
    const { rate } = this.report.scene, step = Math.max(1, Math.round(rate / TRAIL_STEPS)), now = Math.floor(frame), count = this.labels.length;
    const last = this.observed.length / 3 / count - 1;
    for (let m = 0; m < count; m++) {
      if (selected >= 0 && m !== selected) continue;
      const to = selected === m ? now + rate * TRAIL : frame;
      let from = null;
      for (let i = Math.max(0, step * Math.ceil((now - rate * TRAIL) / step)); i <= Math.min(to, last); i += step) {
        const at = this.at(this.observed, i, m), fade = 1 - Math.abs(i - frame) / (rate * TRAIL);
        if (from && at) this.scene.lines.add(from, at, [...colors.observed, 0.15 + 0.75 * clamp(fade, 0, 1)], 1.6 * this.#dpr());
        from = at;
      }
      const here = selected !== m && from && this.at(this.observed, frame, m);
      if (here) this.scene.lines.add(from, here, [...colors.observed, 0.9], 1.6 * this.#dpr());
    }
  }
  #placed({ latent, skin }, colors) {
    this.scene.markers.add(latent, 0.0105, [...colors.predicted, 1], 0);
    this.scene.lines.add(skin, latent, [...colors.predicted, 0.9], 2 * this.#dpr());
  }
  #seen({ m, observed, predicted, error }, state, colors) {
    const { markers, lines } = this.scene, { layers } = state, dpr = this.#dpr();
    if (layers.errors && error !== null && error > 0.5) {
      lines.add(observed, predicted, [...colors.error, 0.95], 2.2 * dpr);
    }
    if (layers.observed && observed) {
      const trust = this.weightAt(state.frame, m), bad = clamp(1.4 * (1 - trust) - 0.3, 0, 1);
      markers.add(observed, 0.0095, [...colors.observed.map((v, c) => v + bad * (colors.error[c] - v)), 1], 0);
    }
    if (layers.predicted && predicted) markers.add(predicted, 0.0155, [...colors.predicted, 1], 1);
  }
  #skeleton(pose, colors) {
    const place = j => [...pose.bones.subarray(16 * j + 12, 16 * j + 15)], { bones, joints } = this.scene;
    this.report.scene.parents.forEach((p, j) => {
      if (p >= 0) bones.add(place(p), place(j), [...colors.skeleton, 0.85], 2.6 * this.#dpr());
      joints.add(place(j), 0.009, [...colors.skeleton, 1], 0);
    });
  }
  #dpr() { return Math.min(window.devicePixelRatio || 1, 2); }

  // Screen positions in CSS pixels: [{item, x, y, which}] of all visible dots, in a part of the canvas from left on.
  project(moment, state, viewProjection, left = 0, width = this.overlay.clientWidth) {
    const height = this.overlay.clientHeight, dots = [];
    const put = (item, point, which) => {
      const [x, y, , w] = Mat.apply(viewProjection, point);
      if (w > 0 && Math.abs(x) < w) dots.push({ item, which, x: left + (x / w + 1) * width / 2, y: (1 - y / w) * height / 2 });
    };
    for (const item of moment) {
      if (item.latent) put(item, item.latent, 'latent');
      else {
        if (item.observed && state.layers.observed) put(item, item.observed, 'observed');
        if (item.predicted && state.layers.predicted) put(item, item.predicted, 'predicted');
      }
    }
    return dots;
  }
  drawNames(dots, state, colors, names = this.labels, notes = []) {
    const dpr = this.#dpr(), canvas = this.overlay, width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * dpr) || canvas.height !== Math.round(height * dpr)) {
      Object.assign(canvas, { width: Math.round(width * dpr), height: Math.round(height * dpr) });
    }
    const c = canvas.getContext('2d'), named = new Map();
    c.setTransform(dpr, 0, 0, dpr, 0, 0);
    c.clearRect(0, 0, width, height);
    c.font = NAME_FONT;
    c.lineJoin = 'round';
    for (const { item, side, x, y } of dots) {
      const key = `${side ?? ''} ${item.m}`;
      const chosen = item.m === state.selected || item.m === state.hovered;
      if (chosen) {
        c.beginPath();
        c.arc(x, y, 9, 0, 2 * Math.PI);
        Object.assign(c, { lineWidth: 2, strokeStyle: colors.ink });
        c.stroke();
      }
      if ((chosen || state.layers.names) && !named.has(key)) named.set(key, { m: item.m, x, y, chosen });
    }
    Object.assign(c, { lineWidth: 3.5, strokeStyle: colors.halo, fillStyle: colors.ink });
    const taken = [];
    for (const { text, x, y } of notes.sort((a, b) => a.y - b.y)) {
      const place = freePlace(x, y + 7, c.measureText(text).width, taken) ?? [x + 9, y];
      c.strokeText(text, ...place);
      c.fillText(text, ...place);
    }
    for (const { m, x, y } of [...named.values()].sort((a, b) => b.chosen - a.chosen)) {
      const place = freePlace(x, y, c.measureText(names[m]).width, taken);
      if (!place) continue;
      c.strokeText(names[m], ...place);
      c.fillText(names[m], ...place);
    }
  }
}

// Where a name fits beside its dot without covering another name; null where it does not.
function freePlace(x, y, width, taken) {
  for (const [left, top] of [[x + 9, y - 14], [x - 9 - width, y - 14], [x + 9, y + 3], [x - 9 - width, y + 3], [x - width / 2, y - 22]]) {
    if (taken.some(t => left < t[0] + t[2] && t[0] < left + width && Math.abs(top - t[1]) < 12)) continue;
    taken.push([left, top, width]);
    return [left, top + 10];
  }
  return null;
}
