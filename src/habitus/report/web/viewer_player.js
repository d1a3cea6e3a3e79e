// Time, layers, buttons, keys: the player around the scene.
class Player extends EventTarget {
  // others: [{arrays}] of further bodies in the scene
  constructor(report, arrays, root, others = []) {
    super();
    Object.assign(this, { report, arrays, root });
    this.canvas = root.querySelector('#view');
    this.scene = new Scene(this.canvas, arrays, ...others.map(other => other.arrays));
    this.layers = new Layers(report, arrays, this.scene, root.querySelector('#names'));
    this.motions = Object.fromEntries(report.scene.stages.map(s => [s, new Motion(report.scene, arrays, s)]));
    this.frames = this.motions[report.scene.stages[0]].frames;
    this.rate = report.scene.rate;
    this.rest = arrays.get('restJoints');
    this.pose = { bones: new Float32Array(16 * this.rest.length / 3), weights: new Float32Array(16) };
    this.state = {
      frame: 0, playing: false, speed: 1, view: 'motion', stage: report.scene.stages.at(-1), follow: true, selected: -1, hovered: -1,
      layers: { body: true, glass: false, observed: true, predicted: true, errors: true, skeleton: false, names: false, trails: false, guessed: true, tapes: false, skin: false },
      tape: null,
    };
    this.camera = new Camera(this.canvas, () => this.redraw());
    this.path = this.#smoothPath();
    this.resetCamera();
    new ResizeObserver(() => this.colors && this.draw()).observe(this.canvas);
    document.addEventListener('visibilitychange', () => { this.last = null; }); // a hidden page stands still
    this.canvas.addEventListener('webglcontextlost', e => e.preventDefault());
  }
  get time() { return this.state.frame / this.rate; }
  get duration() { return Math.max(0, this.frames - 1) / this.rate; }
  get aspect() { return this.canvas.clientWidth / Math.max(this.canvas.clientHeight, 1); }
  get captureFrame() { return Math.round(this.state.frame * this.report.scene.stride); }

  set(changes) {
    Object.assign(this.state, changes);
    this.dispatchEvent(new Event('state'));
    this.redraw();
  }
  toggle(layer) {
    const { layers } = this.state;
    this.set({ layers: { ...layers, [layer]: !layers[layer] } });
  }
  seek(frame) { this.set({ frame: clamp(frame, 0, this.frames - 1), view: 'motion' }); }
  seekTime(seconds) { this.seek(seconds * this.rate); }
  step(frames) {
    this.set({ playing: false });
    this.seek(Math.round(this.state.frame) + frames);
  }
  play(playing = !this.state.playing) {
    if (this.frames < 2) return;
    if (playing && this.state.frame >= this.frames - 1) this.state.frame = 0;
    this.set({ playing, view: playing ? 'motion' : this.state.view });
    this.last = null;
  }
  show(view) {
    this.set({ view, playing: false });
    this.resetCamera();
  }
  otherView() { this.show(this.state.view === 'motion' ? 'placement' : 'motion'); }
  resetCamera() {
    const heights = this.report.scene.height, { aspect } = this;
    const room = Math.max(0.58 * heights, 0.42 * heights / Math.max(aspect, 0.3)) / Math.tan(FOV / 2);
    const placement = this.state.view === 'placement', { follow } = this.state;
    const heading = placement ? 0 : this.motions[this.state.stage].headingAt(this.state.frame);
    const reach = placement || follow ? room : Math.max(room, this.extent / Math.tan(FOV / 2) / Math.min(aspect, 1));
    this.camera.set(heading + (placement ? 0.25 : 0.55), placement ? 0.06 : 0.14, placement ? 1.05 * reach : reach);
    this.redraw();
  }
  target() {
    const { height, floor } = this.report.scene;
    if (this.state.view === 'placement') return [0, this.restFloor + 0.5 * height, 0];
    if (!this.state.follow) return this.center;
    const i = clamp(Math.floor(this.state.frame), 0, this.frames - 1), k = Math.min(i + 1, this.frames - 1), u = this.state.frame - i;
    const at = [0, 1, 2].map(c => (1 - u) * this.path[3 * i + c] + u * this.path[3 * k + c]);
    return [at[0], Math.max(at[1] - 0.03 * height, floor + 0.3 * height), at[2]];
  }
  redraw() {
    if (this.pending) return;
    this.pending = true;
    requestAnimationFrame(now => this.#frame(now));
  }
  #frame(now) {
    this.pending = false;
    const { state } = this;
    if (state.playing) {
      if (this.last !== null) state.frame += Math.max(now - this.last, 0) / 1000 * this.rate * state.speed; // slow machines skip frames
      this.last = now;
      if (state.frame >= this.frames - 1) state.frame = state.frame % Math.max(this.frames - 1, 1);
    }
    this.draw();
    this.dispatchEvent(new Event('time'));
    if (state.playing) this.redraw();
  }
  draw() {
    this.scene.resize();
    const { state, scene, layers } = this, placement = state.view === 'placement';
    if (placement) restPose(this.rest, this.pose);
    else this.motions[state.stage].sample(state.frame, this.pose);
    const view = this.camera.matrices(this.target()), colors = this.colors;
    layers.markGuessed(this.pose, state.frame * this.report.scene.stride, !placement && state.layers.guessed);
    const moment = layers.moment(state);
    layers.fill(state, moment, this.pose, colors);
    const floor = placement ? this.restFloor : this.report.scene.floor;
    const bodies = [{ skin: scene.skins[0], pose: this.pose }];
    scene.draw({ ...view, light: this.camera.light, bodies, floor, colors, reach: 3 + 2.2 * this.camera.distance, show: { floor: true, ...state.layers } });
    this.dots = layers.project(moment, state, view.viewProjection);
    const notes = layers.tapeNames(state, view.viewProjection, name => this.report.measured[name] ?? '');
    layers.drawNames(this.dots, state, colors, layers.labels, notes);
    this.moment = moment;
    this.viewProjection = view.viewProjection;
  }
  // The nearest marker to a point of the canvas (CSS pixels).
  pick(x, y, reach = 16) {
    let best = null, least = reach;
    for (const dot of this.dots || []) {
      const away = Math.hypot(dot.x - x, dot.y - y);
      if (away < least) { least = away; best = dot; }
    }
    return best;
  }
  // What is said of a marker that is pointed at, line by line.
  facts({ item, which }) {
    const { report, layers, state } = this, label = report.labels[item.m];
    if (which === 'latent') return [label, `${(1000 * layers.skinDistance[item.m]).toFixed(1)} mm from the skin`];
    const mean = report.plots.markerMeans[state.stage][item.m], lines = [label, which];
    lines.push(item.error === null ? 'not visible in this frame' : `${item.error.toFixed(1)} mm error now`);
    if (mean !== null) lines.push(`${mean.toFixed(1)} mm on average`);
    const trust = layers.weightAt(state.frame, item.m);
    if (item.error !== null && trust < 0.9) lines.push(`counts for ${Math.round(100 * trust)} %`);
    return lines;
  }
  #smoothPath() {
    const motion = this.motions[this.state.stage], n = this.frames, wide = Math.max(1, Math.round(0.35 * this.rate));
    let path = Float32Array.from(motion.root.subarray(0, 3 * n));
    for (let pass = 0; pass < 3; pass++) path = boxFilter(path, n, wide);
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (let i = 0; i < 3 * n; i++) { low[i % 3] = Math.min(low[i % 3], path[i]); high[i % 3] = Math.max(high[i % 3], path[i]); }
    this.center = low.map((v, c) => (v + high[c]) / 2);
    this.extent = Math.max(...low.map((v, c) => (high[c] - v) / 2)) + 0.6 * this.report.scene.height;
    this.restFloor = this.arrays.contents.vertices.low[1];
    return path;
  }
}

function boxFilter(path, n, wide) {
  const out = new Float32Array(path.length);
  for (let c = 0; c < 3; c++) {
    const sums = new Float64Array(n + 1);
    for (let i = 0; i < n; i++) sums[i + 1] = sums[i] + path[3 * i + c];
    for (let i = 0; i < n; i++) {
      const from = Math.max(0, i - wide), to = Math.min(n, i + wide + 1);
      out[3 * i + c] = (sums[to] - sums[from]) / (to - from);
    }
  }
  return out;
}
