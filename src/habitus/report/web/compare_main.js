// Starts the comparison. The page says in data-ready when it has drawn once, and in data-errors what went wrong.
function unpacked(report, id) {
  return new Arrays(report.arrays, document.getElementById(id).textContent.trim(), report.bytes);
}

function sideColors() {
  const style = getComputedStyle(document.documentElement), read = name => parseColor(style.getPropertyValue(name));
  const sides = [read('--side-a'), read('--side-b')];
  return { ...sceneColors(), guess: read('--error'), sides, bones: sides.map(color => color.map(v => 0.6 * v)) };
}

function curves(root, compared, arrays, which, unit, onSeek) {
  const series = which.filter(one => arrays.has(one.array)).map(one => ({ ...one, values: arrays.get(one.array) }));
  if (!series.length) { root.hidden = true; return null; }
  return new TimePlot(root, {
    times: Array.from(arrays.get('times')), end: Math.max(compared.end, 1e-3), series: series.reverse(), unit, axis: `${root.dataset.axis} (${unit})`,
    label: root.dataset.label, missing: 'not known',
  }, onSeek);
}

function start() {
  const report = JSON.parse(document.getElementById('report-data').textContent), root = document.getElementById('player');
  const arrays = unpacked(report, 'arrays-a'), other = { report: report.other, arrays: unpacked(report.other, 'arrays-b') };
  const byId = id => document.getElementById(id);
  let player = null, keepInSight = () => {};
  const seek = t => { player?.seekTime(t); keepInSight(); };
  const shown = report.curves ?? [
    { array: 'distance/skin', name: 'Skin, mean', on: true, style: 'final' }, { array: 'distance/joints', name: 'Joints, mean', on: true, style: 'before' },
    { array: 'distance/aligned', name: 'Joints, root-aligned', on: false, style: 'right' }, { array: 'distance/worst', name: 'Largest distance', on: false, style: 'worst' },
  ];
  const distances = curves(byId('distance-plot'), report, arrays, shown, report.unit ?? 'mm', seek);
  const errors = byId('error-plot') && curves(byId('error-plot'), report, arrays, [
    { array: 'error/a', name: 'A', on: true, style: 'side-a' }, { array: 'error/b', name: 'B', on: true, style: 'side-b' },
  ], 'mm', seek);
  const angles = byId('angle-plot') && anglePlot(byId('angle-plot'), report, arrays, seek);
  const values = arrays.get(shown.find(one => arrays.has(one.array)).array), times = arrays.get('times');
  const timeline = () => strip(root.querySelector('#strip'), { values, at: times.map(t => t * report.rate), frames: report.frames });
  try {
    player = new PairPlayer(report, arrays, other, root);
    player.colors = sideColors();
    new Controls(player, root);
    keepInSight = docking(root);
    body.dataset.webgl = 'yes';
  } catch (problem) {
    body.dataset.webgl = 'no';
    root.classList.add('broken');
    root.querySelector('#broken').textContent = `The 3D player could not start (${problem.message}). Everything below works without it.`;
    player = null;
  }
  const timed = [distances, errors, angles];
  player?.addEventListener('time', () => { for (const part of timed) part?.moveTo(player.time); });
  player?.addEventListener('state', () => { root.dataset.mode = player.state.mode; });
  for (const b of document.querySelectorAll('[data-time]')) {
    b.addEventListener('click', () => { player?.set({ playing: false, selected: player.names.indexOf(b.dataset.marker ?? '') }); seek(Number(b.dataset.time)); });
  }
  const repaint = () => { timeline(); if (player) { player.colors = sideColors(); player.redraw(); } };
  document.addEventListener('theme', repaint);
  whenResized(root.querySelector('#strip'), timeline);
  window.habitusReport = { report, arrays, player, distances, errors, angles };
  const follow = () => {
    const wish = new URLSearchParams(location.hash.slice(1));
    if (!player) return;
    if (wish.has('t')) player.seekTime(Number(wish.get('t')) || 0);
    if (wish.has('layers')) player.set({ layers: Object.fromEntries(Object.keys(player.state.layers).map(k => [k, wish.get('layers').split(',').includes(k)])) });
    player.set({ mode: wish.get('mode') === 'over' ? 'over' : 'beside' });
    player.colors = sideColors();
    player.resetCamera();
  };
  follow();
  window.addEventListener('hashchange', follow);
  for (const part of [...timed, player]) part?.draw();
  timeline();
  body.dataset.ready = 'yes';
}

start();
