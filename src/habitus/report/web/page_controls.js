// Buttons, timeline, hover and keys of the player.
class Controls {
  constructor(player, root) {
    Object.assign(this, { player, root, tip: root.querySelector('#tip') });
    this.range = root.querySelector('#time');
    this.recorder = player.recorder = new Recorder(player, player.report.name);
    Object.assign(this.range, { max: player.frames - 1, value: 0 });
    this.#buttons();
    this.#pointer();
    document.addEventListener('keydown', e => this.#key(e));
    player.addEventListener('state', () => this.refresh());
    player.addEventListener('time', () => this.#clock());
    this.refresh();
  }
  #buttons() {
    const { player, root } = this, on = (selector, act) => root.querySelector(selector)?.addEventListener('click', act);
    on('#play', () => player.play());
    on('#bigplay', () => { player.play(true); player.canvas.focus({ preventScroll: true }); });
    on('#back', () => player.step(-1));
    on('#forward', () => player.step(1));
    on('#reset', () => player.resetCamera());
    on('#follow', () => { player.set({ follow: !player.state.follow }); player.resetCamera(); });
    on('#picture', () => this.recorder.picture());
    on('#film', () => this.#film());
    root.querySelector('#film').hidden = !this.recorder.canFilm;
    for (const b of root.querySelectorAll('[data-mode]')) b.addEventListener('click', () => player.set({ mode: b.dataset.mode }));
    on('#full', () => document.fullscreenElement ? document.exitFullscreen() : root.requestFullscreen?.());
    on('#help', () => root.querySelector('#keys').toggleAttribute('hidden'));
    on('#keys', e => e.currentTarget.setAttribute('hidden', ''));
    for (const b of root.querySelectorAll('[data-layer]')) b.addEventListener('click', () => player.toggle(b.dataset.layer));
    for (const b of root.querySelectorAll('[data-view]')) b.addEventListener('click', () => player.show(b.dataset.view));
    for (const b of root.querySelectorAll('[data-stage]')) b.addEventListener('click', () => player.set({ stage: b.dataset.stage }));
    this.range.addEventListener('input', () => player.seek(Number(this.range.value)));
    root.querySelector('#speed').addEventListener('change', e => player.set({ speed: Number(e.target.value) }));
  }
  #film() {
    if (this.recorder.canFilm) this.recorder.turntable(() => this.root.querySelector('#film').setAttribute('aria-pressed', Boolean(this.recorder.recording)));
  }
  refresh() {
    const { state } = this.player, { root } = this;
    root.dataset.view = state.view;
    root.classList.toggle('playing', state.playing);
    if (state.playing) root.classList.add('used');
    root.querySelector('#play').setAttribute('aria-label', state.playing ? 'Pause' : 'Play');
    root.querySelector('#follow').setAttribute('aria-pressed', state.follow);
    for (const b of root.querySelectorAll('[data-layer]')) b.setAttribute('aria-pressed', state.layers[b.dataset.layer]);
    for (const b of root.querySelectorAll('[data-view]')) b.setAttribute('aria-pressed', state.view === b.dataset.view);
    for (const b of root.querySelectorAll('[data-mode]')) b.setAttribute('aria-pressed', state.mode === b.dataset.mode);
    for (const b of root.querySelectorAll('[data-stage]')) b.setAttribute('aria-pressed', state.stage === b.dataset.stage);
    root.querySelector('#speed').value = String(state.speed);
    this.#clock();
  }
  #clock() {
    const { player, root } = this, { time, duration, captureFrame } = player;
    if (document.activeElement !== this.range || player.state.playing) this.range.value = player.state.frame;
    this.range.setAttribute('aria-valuetext', `${time.toFixed(2)} seconds`);
    root.querySelector('#now').textContent = time.toFixed(2);
    root.querySelector('#end').textContent = `${duration.toFixed(2)} s`;
    root.querySelector('#frame').textContent = `frame ${captureFrame + 1} of ${player.report.frames}`;
  }
  #pointer() {
    const { player } = this, { canvas } = player;
    const local = e => { const box = canvas.getBoundingClientRect(); return [e.clientX - box.left, e.clientY - box.top]; };
    let down = null;
    canvas.addEventListener('pointermove', e => { if (!e.buttons) this.#hover(player.pick(...local(e)), e); });
    canvas.addEventListener('pointerleave', () => this.#hover(null));
    canvas.addEventListener('pointerdown', e => { down = [e.clientX, e.clientY]; });
    canvas.addEventListener('pointerup', e => {
      if (!down || Math.hypot(e.clientX - down[0], e.clientY - down[1]) > 5) return;
      const dot = player.pick(...local(e), e.pointerType === 'touch' ? 28 : 16);
      player.set({ selected: dot && dot.item.m !== player.state.selected ? dot.item.m : -1 });
      this.#hover(dot, e);
    });
  }
  #hover(dot, e) {
    const { player, tip } = this, hovered = dot ? dot.item.m : -1;
    tip.hidden = !dot;
    if (dot) {
      tip.replaceChildren(...player.facts(dot).map((text, k) => Object.assign(document.createElement(k ? 'span' : 'b'), { textContent: text })));
      const wide = player.canvas.clientWidth;
      tip.style.left = `${clamp(dot.x + 16, 4, wide - 190)}px`;
      tip.style.top = `${Math.max(dot.y - 12, 4)}px`;
    }
    if (hovered !== player.state.hovered) { player.state.hovered = hovered; player.redraw(); }
  }
  #key(e) {
    if (e.ctrlKey || e.metaKey || e.altKey || e.target.matches('input:not([type=range]), select, textarea')) return;
    const { player } = this, long = e.shiftKey ? 10 : 1;
    const layers = [...this.root.querySelectorAll('[data-layer]')].map(b => b.dataset.layer);
    const acts = {
      ' ': () => player.play(), k: () => player.play(), ArrowLeft: () => player.step(-long), ArrowRight: () => player.step(long),
      Home: () => player.seek(0), End: () => player.seek(player.frames - 1), r: () => player.resetCamera(),
      f: () => this.root.querySelector('#follow').click(), v: () => player.otherView(),
      p: () => this.recorder.picture(), t: () => this.#film(),
      '[': () => this.#faster(-1), ']': () => this.#faster(1), '?': () => this.root.querySelector('#help').click(),
      '+': () => player.camera.zoom(0.87), '=': () => player.camera.zoom(0.87), '-': () => player.camera.zoom(1.15),
      s: () => player.set({ stage: player.report.scene.stages.at(player.state.stage === 'pose' ? -1 : 0) }),
      Escape: () => player.set({ selected: -1, tape: null }),
    };
    layers.forEach((layer, k) => { acts[k + 1] = () => player.toggle(layer); });
    const inside = this.root.contains(e.target) || e.target === document.body;
    if (!acts[e.key] || !inside || (e.key === ' ' && e.target.closest('button, summary, a'))) return;
    if (e.target === this.range && /^(Arrow|Home|End)/.test(e.key)) return;
    e.preventDefault();
    acts[e.key]();
  }
  #faster(step) {
    const options = [...this.root.querySelector('#speed').options].map(o => Number(o.value));
    const k = options.indexOf(this.player.state.speed);
    this.player.set({ speed: options[clamp(k + step, 0, options.length - 1)] });
  }
}
