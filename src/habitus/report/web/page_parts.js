// What all pages with a player do: colours, the strip over the timeline, docking.
// "#rrggbb" to three numbers in 0..1.
function parseColor(text) {
  const hex = text.trim().slice(1);
  return [0, 2, 4].map(k => parseInt(hex.slice(k, k + 2), 16) / 255);
}

function sceneColors() {
  const style = getComputedStyle(document.documentElement), read = name => parseColor(style.getPropertyValue(name));
  const number = name => Number(style.getPropertyValue(name));
  return {
    background: read('--stage'), floor: read('--stage-floor'), line: read('--stage-line'), albedo: read('--skin'), sky: read('--sky'),
    ground: read('--ground'), key: number('--key'), shadow: number('--shadow'), observed: read('--observed'), predicted: read('--predicted'),
    error: read('--error'), skeleton: read('--bone'), guess: read('--guess'), accent: read('--accent'), ink: style.getPropertyValue('--ink'), halo: style.getPropertyValue('--stage'),
  };
}

// Bars of the values over the timeline; at: each value's frame, where there is not one a frame; flagged: which are red.
function strip(canvas, { values, flagged = [], at = null, frames }) {
  const c = canvas.getContext('2d');
  const width = canvas.width = Math.max(1, canvas.clientWidth), height = canvas.height = Math.max(1, canvas.clientHeight);
  const style = getComputedStyle(document.documentElement), most = Math.max(10, ...values.filter(v => v === v));
  c.clearRect(0, 0, width, height);
  for (let i = 0; i < values.length; i++) {
    const x = (at ? at[i] : i) / Math.max(frames - 1, 1) * width, tall = (values[i] === values[i] ? values[i] / most : 0) * height;
    c.fillStyle = style.getPropertyValue(flagged[i] ? '--warn' : '--strip');
    c.fillRect(x, height - tall, Math.max(width / values.length, 1) + 0.5, tall);
  }
}

// Whoever uses a plot below the player keeps it in sight: it shrinks into a corner while its own place is off the screen.
// Gives what to call when the player is wanted.
function docking(root) {
  let wanted = false;
  const apply = () => {
    const { top, bottom, height } = root.getBoundingClientRect(), seen = Math.min(bottom, innerHeight) - Math.max(top, 0);
    if (seen > 0.4 * Math.min(height, innerHeight)) wanted = false;
    const docked = wanted && !document.fullscreenElement;
    if (docked && !root.classList.contains('docked')) root.style.minHeight = `${root.offsetHeight}px`;
    root.classList.toggle('docked', docked);
    if (!docked) root.style.minHeight = '';
  };
  for (const name of ['scroll', 'resize', 'fullscreenchange']) addEventListener(name, apply, { passive: true });
  root.querySelector('#undock').addEventListener('click', () => { wanted = false; apply(); });
  return () => { wanted = true; apply(); };
}
