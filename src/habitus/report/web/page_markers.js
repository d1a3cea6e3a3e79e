// The markers one by one: bars of mean error, and a map of error over time.
const KINDS = { wrong: 'suspect', doubted: 'briefly suspect', corrected: 'corrected' };

class MarkerBars {
  constructor(root, report, onSelect) {
    Object.assign(this, { report, onSelect, rows: [] });
    const last = report.scene.stages.at(-1), means = report.plots.markerMeans;
    this.order = report.labels.map((_, m) => m).sort((a, b) => (means[last][b] ?? -1) - (means[last][a] ?? -1));
    const most = barRange(report.scene.stages.flatMap(s => means[s].map(v => v ?? 0)));
    root.style.setProperty('--label', `${clamp(Math.max(...report.labels.map(l => l.length)) * 7.4 + 24, 60, 150)}px`);
    root.replaceChildren(...this.order.map(m => this.#row(m, last, most)));
  }
  #row(m, last, most) {
    const { report } = this, { markerMeans, downWeighted, missing } = report.plots, suspect = report.suspects[m];
    const make = (tag, className, text) => Object.assign(document.createElement(tag), { className, textContent: text ?? '' });
    const item = document.createElement('li'), row = Object.assign(make('button', suspect ? `bar ${KINDS[suspect.kind]}` : 'bar'), { type: 'button' });
    const track = make('span', 'track');
    for (const stage of report.scene.stages) {
      const bar = make('span', stage === last ? 'final' : 'before');
      const share = (markerMeans[stage][m] ?? 0) / most;
      bar.style.width = `${100 * Math.min(share, 1)}%`;
      bar.classList.toggle('over', share > 1.001);
      track.append(bar);
    }
    const mean = markerMeans[last][m];
    row.append(make('span', 'label', report.labels[m]), track, make('span', 'value', mean === null ? '–' : mean.toFixed(1)));
    const notes = [];
    if (last !== 'pose' && markerMeans.pose[m] !== null) notes.push(`pose stage ${markerMeans.pose[m].toFixed(1)} mm`);
    if (missing[m] > 0.0005) notes.push(`not seen in ${(100 * missing[m]).toFixed(1)} % of frames`);
    if (downWeighted[m] > 0.0005) notes.push(`down-weighted in ${(100 * downWeighted[m]).toFixed(1)} %`);
    row.title = [...(suspect?.reasons || []), ...notes].join('; ');
    row.addEventListener('click', () => this.onSelect(m));
    this.rows[m] = row;
    item.append(row);
    if (suspect && suspect.kind !== 'doubted') item.append(make('span', `why ${suspect.kind}`, suspect.reasons.join('; ') + (suspect.kind === 'corrected' ? '; corrected by the fit' : '')));
    return item;
  }
  select(m) { this.rows.forEach((row, k) => row.setAttribute('aria-pressed', k === m)); }
}

// Rows of cells over time, a row a marker, tied to the player's clock. paint(m, bin) gives a cell's colour as [r, g, b]
// in 0..255, describe(m, bin) its words.
class MarkerMap {
  constructor(root, report, what, onPick) {
    Object.assign(this, { root, report, onPick, now: 0, row: 13 }, what);
    Object.assign(this, { canvas: root.querySelector('canvas'), tip: root.querySelector('.plot-tip'), bins: report.plots.mapBins });
    this.end = Math.max(report.frames - 1, 1) / report.rate;
    whenResized(root, () => this.draw());
    this.#pointer();
  }
  draw() {
    const dpr = Math.min(window.devicePixelRatio || 1, 2), { canvas, order, row } = this, width = this.root.clientWidth;
    if (!width || !order.length) return;
    this.left = 12 + Math.min(78, Math.max(...order.map(m => this.report.labels[m].length)) * 6.4);
    const height = order.length * row;
    Object.assign(canvas, { width: Math.round(width * dpr), height: Math.round((height + 24) * dpr) });
    canvas.style.height = `${height + 24}px`;
    const c = canvas.getContext('2d'), style = getComputedStyle(document.documentElement);
    c.setTransform(dpr, 0, 0, dpr, 0, 0);
    c.imageSmoothingEnabled = false;
    c.drawImage(this.#picture(), this.left, 0, width - this.left, height);
    c.fillStyle = style.getPropertyValue('--card');
    for (let k = 1; k < order.length; k++) c.fillRect(this.left, k * row - 0.5, width - this.left, 1);
    c.font = `500 10px ${style.getPropertyValue('--font')}`;
    c.textBaseline = 'middle';
    order.forEach((m, k) => {
      c.fillStyle = style.getPropertyValue({ wrong: '--warn', corrected: '--good' }[this.report.suspects[m]?.kind] || '--muted');
      c.fillText(fitText(c, this.report.labels[m], this.left - 6), 0, k * row + row / 2 + 0.5);
    });
    c.textAlign = 'center';
    c.fillStyle = style.getPropertyValue('--muted');
    for (const t of ticks(0, this.end, width / 95)) c.fillText(`${t}`, this.x(t, width), height + 13);
    this.moveTo(this.now);
  }
  x(time, width = this.root.clientWidth) { return this.left + clamp(time / this.end, 0, 1) * (width - this.left); }
  #picture() {
    const paint = this.paint(), { bins, order } = this, picture = new ImageData(bins, order.length);
    order.forEach((m, k) => {
      for (let b = 0; b < bins; b++) {
        const at = 4 * (k * bins + b);
        picture.data.set(paint(m, b), at);
        picture.data[at + 3] = 255;
      }
    });
    const canvas = Object.assign(document.createElement('canvas'), { width: bins, height: order.length });
    canvas.getContext('2d').putImageData(picture, 0, 0);
    return canvas;
  }
  moveTo(time) {
    this.now = time;
    if (!this.left) return;
    const cursor = this.root.querySelector('.map-cursor');
    Object.assign(cursor.style, { left: `${this.x(time) - 0.75}px`, height: `${this.order.length * this.row}px` });
  }
  #pointer() {
    const find = e => {
      const box = this.canvas.getBoundingClientRect(), k = Math.floor((e.clientY - box.top) / this.row);
      const u = (e.clientX - box.left - this.left) / (box.width - this.left);
      return k < this.order.length && u >= 0 ? { m: this.order[k], time: clamp(u, 0, 1) * this.end, x: e.clientX - box.left, y: e.clientY - box.top } : null;
    };
    this.canvas.addEventListener('pointermove', e => this.#hover(find(e)));
    this.canvas.addEventListener('pointerleave', () => this.#hover(null));
    this.canvas.addEventListener('click', e => { const at = find(e); if (at) this.onPick(at.m, at.time); });
  }
  #hover(at) {
    this.tip.hidden = !at;
    if (!at) return;
    const bin = Math.min(this.bins - 1, Math.floor(at.time / this.end * this.bins));
    const lines = [this.report.labels[at.m], `${at.time.toFixed(2)} s`, this.describe(at.m, bin)];
    this.tip.replaceChildren(...lines.map((text, k) => Object.assign(document.createElement(k ? 'span' : 'b'), { textContent: text })));
    const wide = this.tip.offsetWidth, room = this.root.clientWidth;
    Object.assign(this.tip.style, { left: `${at.x + 14 + wide > room ? at.x - 14 - wide : at.x + 14}px`, top: `${at.y + 12}px` });
  }
}

const bytes = color => color.map(v => 255 * v);

function errorMap(root, report, arrays, order, onPick) {
  const values = arrays.get('errorMap'), { mapBins: bins, mapStep: step } = report.plots;
  const seen = values.filter(v => v < 255).sort(), cap = Math.max(20, Math.ceil((seen[Math.floor(0.995 * seen.length)] ?? 0) * step / 10) * 10);
  document.querySelector('.map-key .cap').textContent = `${cap} mm or more`;
  const paint = () => {
    const style = getComputedStyle(document.documentElement), read = name => bytes(parseColor(style.getPropertyValue(name)));
    const stops = [0, 1, 2, 3, 4].map(k => read(`--ramp-${k}`)), none = read('--ramp-none');
    const table = Array.from({ length: 255 }, (_, v) => {
      const u = Math.min(1, v * step / cap) * 4, k = Math.min(3, Math.floor(u));
      return stops[k].map((from, c) => from + (u - k) * (stops[k + 1][c] - from));
    });
    return (m, b) => table[values[m * bins + b]] || none;
  };
  const describe = (m, b) => values[m * bins + b] === 255 ? 'not visible' : `${(values[m * bins + b] * step).toFixed(1)} mm`;
  return new MarkerMap(root, report, { order, paint, describe }, onPick);
}

// When each marker is missing or down-weighted; only markers that ever are, those with the longest gaps first.
function gapMap(section, report, arrays, onPick) {
  const packed = arrays.get('gapMap'), { mapBins: bins, missing, downWeighted } = report.plots;
  const state = (m, b) => packed[(m * bins + b) >> 2] >> 2 * ((m * bins + b) & 3) & 3;
  const troubled = report.labels.map((_, m) => m).filter(m => missing[m] > 0 || downWeighted[m] > 0);
  const order = troubled.sort((a, b) => missing[b] - missing[a] || downWeighted[b] - downWeighted[a]);
  const root = section.querySelector('.map'), none = section.querySelector('.no-gaps');
  none.hidden = order.length > 0;
  root.hidden = section.querySelector('.map-key').hidden = !order.length;
  const paint = () => {
    const style = getComputedStyle(document.documentElement), read = name => bytes(parseColor(style.getPropertyValue(name)));
    const colors = ['--soft', '--partly', '--gone', '--observed'].map(read), kinds = { wrong: read('--warn'), corrected: read('--good') };
    return (m, b) => state(m, b) === 3 && kinds[report.suspects[m]?.kind] || colors[state(m, b)];
  };
  const words = ['seen', 'missing in some frames', 'missing', 'far from the body, so down-weighted'];
  return new MarkerMap(root, report, { order, paint, describe: (m, b) => words[state(m, b)] }, onPick);
}

// The length of a whole bar: the largest value, unless a few dwarf the rest; those are drawn broken.
function barRange(values) {
  const sorted = [...values].sort((a, b) => a - b), most = sorted.at(-1) ?? 1;
  return Math.max(1, Math.min(most, 2.5 * sorted[Math.floor(0.9 * (sorted.length - 1))]));
}

function fitText(c, text, width) {
  if (c.measureText(text).width <= width) return text;
  let cut = text;
  while (cut.length > 1 && c.measureText(`${cut}…`).width > width) cut = cut.slice(0, -1);
  return `${cut}…`;
}
