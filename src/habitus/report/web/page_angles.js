// Joint angles over time: a button an angle, left and right in one plot.
function anglePlot(root, report, arrays, onSeek) {
  if (!report.angles.length) { root.hidden = true; return null; }
  const all = arrays.get('angles'), frames = arrays.get('angleFrames'), rows = report.angles.length;
  const names = [...new Set(report.angles.map(a => a.name))], word = { left: 'Left', right: 'Right', '': 'Middle of the body' };
  const upper = text => text[0].toUpperCase() + text.slice(1);
  const series = name => report.angles.flatMap((a, k) => a.name !== name ? [] : [{
    name: a.whose ? `${word[a.side]}, ${a.whose}` : word[a.side], values: Float32Array.from(frames, (_, i) => all[i * rows + k] / 10), on: true,
    style: `${a.side === 'right' ? 'right' : 'final'}${a.whose === 'B' ? ' other' : ''}`,
  }]).reverse();
  const plot = new TimePlot(root, {
    times: Array.from(frames, f => f / report.rate), end: Math.max(report.frames - 1, 1) / report.rate, series: series(names[0]),
    unit: '°', axis: 'angle (°)', label: 'Joint angle over time, in degrees', missing: 'unknown',
  }, onSeek);
  const choice = root.querySelector('.angles');
  const choose = name => {
    for (const b of choice.children) b.setAttribute('aria-pressed', b.dataset.angle === name);
    plot.show(series(name));
  };
  choice.replaceChildren(...names.map(name => {
    const b = Object.assign(document.createElement('button'), { type: 'button', textContent: upper(name) });
    b.dataset.angle = name;
    b.addEventListener('click', () => choose(name));
    return b;
  }));
  choose(names[0]);
  return plot;
}
