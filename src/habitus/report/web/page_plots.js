// Curves over time: an SVG drawn anew at each width, tied to the player's clock.
const SVG = 'http://www.w3.org/2000/svg';

function svg(name, attributes = {}, text = null) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  if (text !== null) node.textContent = text;
  return node;
}

function ticks(low, high, wanted) {
  const raw = (high - low) / Math.max(wanted, 1) || 1, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map(k => k * power).find(s => s >= raw * 0.999), out = [];
  for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + 1e-9 * step; v += step) out.push(Number(v.toFixed(10)));
  return out;
}

// Index of the last entry that is not greater than value.
function lastNotAfter(sorted, value) {
  let low = 0, high = sorted.length - 1;
  while (low < high) { const mid = (low + high + 1) >> 1; if (sorted[mid] <= value) low = mid; else high = mid - 1; }
  return low;
}

function errorSeries(report, arrays) {
  const last = report.scene.stages.at(-1), name = { pose: 'Pose stage', soft_tissue: 'Soft-tissue stage' }, out = [];
  out.push({ name: 'Worst marker', values: arrays.get(`${last}/worstError`), on: false, style: 'worst' });
  if (last !== 'pose') out.push({ name: `${name.pose}, mean`, values: arrays.get('pose/meanError'), on: true, style: 'before' });
  out.push({ name: `${name[last]}, mean`, values: arrays.get(`${last}/meanError`), on: true, style: 'final' });
  return out;
}

function errorPlot(root, report, arrays, onSeek) {
  const bins = arrays.shape('visible')[0], frames = report.plots.plotFrames || Array.from({ length: bins }, (_, i) => i);
  const flagged = arrays.get('flagged'), visible = arrays.get('visible');
  return new TimePlot(root, {
    times: frames.map(f => f / report.rate), end: Math.max(report.frames - 1, 1) / report.rate, series: errorSeries(report, arrays), flagged,
    unit: 'mm', axis: 'error (mm)', label: 'Marker error over time, in millimetres', missing: 'no visible marker',
    tail: i => `${Math.round(visible[i])} of ${report.labels.length} markers seen${flagged[i] ? ', flagged' : ''}`,
  }, onSeek);
}

// what: times, end, series [{name, values, on, style}], unit, axis, label, missing; flagged (a list) and tail (a line of the tip) may be absent
class TimePlot {
  constructor(root, what, onSeek) {
    Object.assign(this, { root, onSeek, flagged: [], tail: null, now: 0 }, what);
    this.figure = root.querySelector('.plot');
    this.tip = root.querySelector('.plot-tip');
    this.#legend();
    whenResized(this.figure, () => this.draw());
    this.#pointer();
  }
  show(series) {
    this.series = series;
    this.#legend();
    this.draw();
  }
  #legend() {
    const legend = this.root.querySelector('.legend');
    legend.replaceChildren();
    for (const series of [...this.series].reverse()) {
      const button = Object.assign(document.createElement('button'), { type: 'button', className: `key ${series.style}`, textContent: series.name });
      button.setAttribute('aria-pressed', series.on);
      button.addEventListener('click', () => {
        series.on = !series.on;
        button.setAttribute('aria-pressed', series.on);
        this.draw();
      });
      legend.append(button);
    }
  }
  draw() {
    const width = this.figure.clientWidth, height = width < 560 ? 190 : 230;
    if (!width) return;
    const box = { left: 44, right: width - 10, top: 10, bottom: height - 34 };
    const shown = this.series.filter(s => s.on);
    const most = shown.reduce((m, s) => s.values.reduce((a, v) => v > a ? v : a, m), 1);
    const least = shown.reduce((m, s) => s.values.reduce((a, v) => v < a ? v : a, m), 0);
    const yTicks = ticks(least * 1.04, most * 1.04, 4), top = Math.max(most * 1.04, yTicks.at(-1)), low = least * 1.04;
    this.x = t => box.left + t / this.end * (box.right - box.left);
    this.y = v => box.bottom - (v - low) / (top - low) * (box.bottom - box.top);
    this.box = box;
    const picture = svg('svg', { width, height, viewBox: `0 0 ${width} ${height}`, role: 'img', 'aria-label': this.label });
    this.#flags(picture);
    this.#axes(picture, yTicks, width);
    for (const s of this.series) if (s.on) picture.append(svg('path', { class: `line ${s.style}`, d: this.#path(s.values) }));
    this.cursor = svg('line', { class: 'cursor', y1: box.top, y2: box.bottom });
    this.pointer = svg('line', { class: 'pointer', y1: box.top, y2: box.bottom, visibility: 'hidden' });
    picture.append(this.pointer, this.cursor);
    this.figure.replaceChildren(picture);
    this.moveTo(this.now);
  }
  #axes(picture, yTicks, width) {
    const { left, right, bottom, top } = this.box;
    for (const v of yTicks) {
      picture.append(svg('line', { class: v ? 'grid' : 'axis', x1: left, x2: right, y1: this.y(v), y2: this.y(v) }));
      picture.append(svg('text', { class: 'tick', x: left - 7, y: this.y(v) + 4, 'text-anchor': 'end' }, String(v)));
    }
    for (const t of ticks(0, this.end, width / 95)) {
      picture.append(svg('line', { class: 'axis', x1: this.x(t), x2: this.x(t), y1: bottom, y2: bottom + 4 }));
      picture.append(svg('text', { class: 'tick', x: this.x(t), y: bottom + 17, 'text-anchor': 'middle' }, String(t)));
    }
    picture.append(svg('text', { class: 'unit', x: right, y: bottom + 31, 'text-anchor': 'end' }, 'time (s)'));
    const middle = (top + bottom) / 2;
    picture.append(svg('text', { class: 'unit', x: 11, y: middle, 'text-anchor': 'middle', transform: `rotate(-90 11 ${middle})` }, this.axis));
  }
  #flags(picture) {
    const { top, bottom } = this.box;
    for (let i = 0; i < this.flagged.length; i++) {
      if (!this.flagged[i] || this.flagged[i - 1]) continue;
      let end = i;
      while (this.flagged[end + 1]) end++;
      const x = this.x(this.times[i]), right = this.x(this.times[end + 1] ?? this.end);
      picture.append(svg('rect', { class: 'flag', x, y: top, width: Math.max(right - x, 1.5), height: bottom - top }));
    }
  }
  #path(values) {
    let out = '', pen = false;
    for (let i = 0; i < values.length; i++) {
      if (values[i] === values[i]) {
        out += `${pen ? 'L' : 'M'}${this.x(this.times[i]).toFixed(1)} ${this.y(values[i]).toFixed(1)}`;
        pen = true;
      } else pen = false;
    }
    return out;
  }
  moveTo(time) {
    this.now = time;
    if (this.cursor) for (const end of ['x1', 'x2']) this.cursor.setAttribute(end, this.x(clamp(time, 0, this.end)));
  }
  #pointer() {
    const { figure } = this;
    const time = e => clamp((e.clientX - figure.getBoundingClientRect().left - this.box.left) / (this.box.right - this.box.left), 0, 1) * this.end;
    figure.addEventListener('pointerdown', e => { figure.setPointerCapture(e.pointerId); this.onSeek(time(e)); });
    figure.addEventListener('pointermove', e => {
      if (e.buttons) this.onSeek(time(e));
      this.#point(time(e), e);
    });
    figure.addEventListener('pointerleave', () => { this.tip.hidden = true; this.pointer?.setAttribute('visibility', 'hidden'); });
  }
  #point(time) {
    const i = lastNotAfter(this.times, time), x = this.x(time);
    for (const end of ['x1', 'x2']) this.pointer.setAttribute(end, x);
    this.pointer.setAttribute('visibility', 'visible');
    const lines = [`${time.toFixed(2)} s`];
    for (const s of [...this.series].reverse()) if (s.on) lines.push(`${s.name}: ${s.values[i] === s.values[i] ? `${s.values[i].toFixed(1)} ${this.unit}` : this.missing}`);
    if (this.tail) lines.push(this.tail(i));
    this.tip.replaceChildren(...lines.map((text, k) => Object.assign(document.createElement(k ? 'span' : 'b'), { textContent: text })));
    this.tip.hidden = false;
    const room = this.figure.clientWidth, wide = this.tip.offsetWidth;
    this.tip.style.left = `${x + 14 + wide > room ? x - 14 - wide : x + 14}px`;
  }
}
