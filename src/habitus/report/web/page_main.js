// Starts everything. The page says in data-ready when it has drawn once, and in data-errors what went wrong.
function start() {
  const report = JSON.parse(document.getElementById('report-data').textContent);
  const arrays = new Arrays(report.arrays, document.getElementById('report-arrays').textContent.trim(), report.bytes);
  const root = document.getElementById('player'), plotRoot = document.getElementById('time-plot');
  let player = null;
  let keepInSight = () => {};
  const seek = t => { player?.seekTime(t); keepInSight(); };
  const select = m => { player?.set({ selected: player.state.selected === m ? -1 : m }); keepInSight(); };
  const pick = (m, t) => { seek(t); player?.set({ selected: m }); };
  const plot = errorPlot(plotRoot, report, arrays, seek);
  const angles = anglePlot(document.getElementById('angle-plot'), report, arrays, seek);
  const bars = new MarkerBars(document.getElementById('marker-bars'), report, select);
  const map = errorMap(document.getElementById('error-map'), report, arrays, bars.order, pick);
  const gaps = gapMap(document.getElementById('gaps'), report, arrays, pick);
  const timeline = () => strip(root.querySelector('#strip'), {
    values: arrays.get(`${report.scene.stages.at(-1)}/meanError`), flagged: arrays.get('flagged'), at: report.plots.plotFrames, frames: report.frames,
  });
  try {
    player = new Player(report, arrays, root);
    player.colors = sceneColors();
    new Controls(player, root);
    keepInSight = docking(root);
    body.dataset.webgl = 'yes';
  } catch (problem) {
    body.dataset.webgl = 'no';
    root.classList.add('broken');
    root.querySelector('#broken').textContent = `The 3D player could not start (${problem.message}). Everything below works without it.`;
    player = null;
  }
  const tapes = [...document.querySelectorAll('[data-tape]')];
  for (const b of tapes) b.addEventListener('click', () => {
    if (player && player.state.view !== 'placement') player.show('placement');
    player?.set({ tape: player.state.tape === b.dataset.tape ? null : b.dataset.tape });
    keepInSight();
  });
  player?.addEventListener('state', () => { for (const b of tapes) b.setAttribute('aria-pressed', b.dataset.tape === player.state.tape); });
  const timed = [plot, angles, map, gaps];
  player?.addEventListener('time', () => { for (const part of timed) part?.moveTo(player.time); });
  player?.addEventListener('state', () => bars.select(player.state.selected));
  const repaint = () => { timeline(); map.draw(); gaps.draw(); if (player) { player.colors = sceneColors(); player.redraw(); } };
  document.addEventListener('theme', repaint);
  whenResized(root.querySelector('#strip'), timeline);
  window.habitusReport = { report, arrays, player, plot, angles, map, gaps };
  follow(player, report);
  window.addEventListener('hashchange', () => follow(player, report));
  for (const part of [...timed, player]) part?.draw();
  timeline();
  body.dataset.ready = 'yes';
}

// A link may name a moment: #t=3.2&view=placement&stage=pose&layers=body,skeleton&marker=LKNE&theme=dark
function follow(player, report) {
  const wish = new URLSearchParams(location.hash.slice(1));
  if (!player) return;
  player.colors = sceneColors();
  if (report.scene.stages.includes(wish.get('stage'))) player.set({ stage: wish.get('stage') });
  if (wish.has('t')) player.seekTime(Number(wish.get('t')) || 0);
  if (wish.has('layers')) {
    const names = wish.get('layers').split(',');
    player.set({ layers: Object.fromEntries(Object.keys(player.state.layers).map(k => [k, names.includes(k)])) });
  }
  if (wish.has('marker')) player.set({ selected: report.labels.indexOf(wish.get('marker')) });
  if (wish.get('follow') === 'no') player.set({ follow: false });
  if (wish.get('view') === 'placement') player.show('placement');
  else player.resetCamera();
}

start();
