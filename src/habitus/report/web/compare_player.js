// Two results in one scene and on one clock: side by side under the same camera, or one over the other.
class PairPlayer extends Player {
  constructor(report, arrays, other, root) {
    super(report, arrays, root, [other]);
    const { scene } = other.report, stage = scene.stages.at(-1), rest = other.arrays.get('restJoints');
    this.other = {
      ...other, layers: new Layers(other.report, other.arrays, this.scene, root.querySelector('#names')), stage, scene,
      motion: new Motion(scene, other.arrays, stage), pose: { bones: new Float32Array(16 * rest.length / 3), weights: new Float32Array(16) },
    };
    const { layers } = this.state;
    Object.assign(this.state, { mode: 'beside', layers: { ...layers, observed: false, predicted: false, errors: false, difference: false } });
    // one number for each marker name of either
    this.names = [...new Set([...report.labels, ...other.report.labels])];
    this.own = [report, other.report].map(one => this.names.map(name => one.labels.indexOf(name)));
    this.shared = scene.jointNames.map((name, j) => [report.scene.jointNames.indexOf(name), j]).filter(([a]) => a >= 0);
  }
  get aspect() { return super.aspect / (this.state.mode === 'over' ? 1 : 2); }
  otherView() { this.set({ mode: this.state.mode === 'over' ? 'beside' : 'over' }); }
  get otherFrame() { return clamp((this.time - this.report.offset) * this.other.scene.rate, 0, this.other.motion.frames - 1); }
  draw() {
    if (!this.other) return;
    this.scene.resize();
    const { state, other, scene, colors } = this;
    this.motions[state.stage].sample(state.frame, this.pose);
    other.motion.sample(this.otherFrame, other.pose);
    this.#mark(state.layers.difference);
    const bodies = [
      { skin: scene.skins[0], pose: this.pose, albedo: colors.sides[0] }, { skin: scene.skins[1], pose: other.pose, albedo: colors.sides[1] },
    ];
    const { clientWidth: wide } = this.canvas, { width, height } = this.canvas, half = Math.floor(width / 2);
    if (state.mode === 'over') this.dots = this.#part(bodies, [0, 0, width, height], 0, wide, [0, 1]);
    else {
      this.dots = this.#part(bodies.slice(0, 1), [0, 0, half, height], 0, wide / 2, [0]);
      this.dots.push(...this.#part(bodies.slice(1), [half, 0, width - half, height], wide / 2, wide / 2, [1]));
    }
    this.layers.drawNames(this.dots, state, colors, this.names);
  }
  // Draws some bodies and their markers into a part of the canvas; gives the markers' dots.
  #part(bodies, part, left, wide, sides) {
    const { state, scene, colors, camera } = this, view = camera.matrices(this.target(), part[2] / part[3]), dots = [];
    sides.forEach((side, k) => {
      const [layers, pose, stage, frame] = side ? [this.other.layers, this.other.pose, this.other.stage, this.otherFrame]
        : [this.layers, this.pose, state.stage, state.frame];
      const own = { ...state, stage, frame, view: 'motion', selected: this.own[side][state.selected] ?? -1, hovered: -1 };
      const moment = layers.moment(own), names = layers.labels;
      layers.fill(own, moment, pose, { ...colors, predicted: colors.sides[side], skeleton: colors.bones[side] }, k > 0);
      for (const dot of layers.project(moment, own, view.viewProjection, left, wide)) {
        dots.push({ ...dot, side, item: { ...dot.item, own: dot.item.m, m: this.names.indexOf(names[dot.item.m]) } });
      }
    });
    const { floor } = this.report.scene;
    scene.draw({ ...view, part, light: camera.light, bodies, floor, colors, stripes: 0, reach: 3 + 2.2 * camera.distance, show: { floor: true, ...state.layers } });
    this.viewProjection = view.viewProjection;
    return dots;
  }
  // Joints that lie FAR apart, or further, colour the skin around them.
  #mark(on) {
    const FAR = 0.05, a = this.pose.bones, b = this.other.pose.bones;
    for (const bones of [a, b]) for (let k = 15; k < bones.length; k += 16) bones[k] = 0;
    if (!on) return;
    for (const [i, j] of this.shared) {
      const away = Math.hypot(...[12, 13, 14].map(c => a[16 * i + c] - b[16 * j + c]));
      a[16 * i + 15] = b[16 * j + 15] = clamp(away / FAR, 0, 1);
    }
  }
  facts({ item, which, side }) {
    const layers = side ? this.other.layers : this.layers, lines = [this.names[item.m], `${which}, ${side ? 'B' : 'A'}`];
    lines.push(item.error === null ? 'not seen in this frame' : `${item.error.toFixed(1)} mm from observed now`);
    const trust = layers.weightAt(side ? this.otherFrame : this.state.frame, item.own);
    if (item.error !== null && trust < 0.9) lines.push(`counts for ${Math.round(100 * trust)} %`);
    return lines;
  }
}
