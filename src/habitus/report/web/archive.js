// A table of any length: only the rows in sight are in the document. What is shown is in the address, so that it can be
// kept and sent: #view=captures&levels=failed&subject=ann&q=walk&least=20&suspects=1&sort=-error
const at = id => document.getElementById(id);
const read = id => JSON.parse(at(id).textContent);
const LEVELS = ['good', 'doubtful', 'failed', 'not fitted'];
const HEIGHT = 72, SPARE = 8;
const captures = read('captures-data').map(([name, link, subject, level, why, error, p95, frames, rate, markers, suspects, height, mass, layout, picture]) =>
  ({ name, link, subject, level, why, error, p95, frames, rate, seconds: frames && rate ? frames / rate : null, markers, suspects, height, mass, layout, picture, text: [name, subject, layout, ...why].join('\n').toLowerCase() }));
const subjects = read('subjects-data').map(([name, count, frames, error, levels, height, mass, waist, picture]) =>
  ({ name, count, frames, error, levels, good: levels[0] / count, height, mass, waist, picture, text: name.toLowerCase() }));

const make = (tag, text, className) => {
  const element = document.createElement(tag);
  if (text !== undefined) element.textContent = text;
  if (className) element.className = className;
  return element;
};
const number = (value, digits, unit = '', factor = 1) => value === null || value === undefined ? '–' :
  (factor * value).toLocaleString('en', { minimumFractionDigits: digits, maximumFractionDigits: digits }) + unit;
const duration = s => s === null ? '–' : s < 60 ? `${s.toFixed(1)} s` : `${Math.floor(s / 60)}:${String(Math.floor(s % 60)).padStart(2, '0')} min`;
const image = row => {
  if (!row.picture) return make('span');
  const found = make('img');
  found.alt = '';
  found.src = 'data:image/png;base64,' + row.picture;
  return found;
};
const pill = row => {
  if (!row.level) return make('span', '–');
  const found = make('span', row.level, 'level ' + row.level);
  found.title = row.why.join('\n');
  return found;
};
const named = row => {
  const cell = make('div'), line = row.link ? make('a', row.name) : make('span', row.name);
  if (row.link) line.href = row.link;
  line.title = row.name;
  cell.append(line);
  if (row.level !== 'good' && row.why.length) {
    const why = make('span', row.why.join(' '), 'why');
    why.title = row.why.join('\n');
    cell.append(why);
  }
  return cell;
};
const chosen = name => {
  const found = make('button', name, 'plain');
  found.type = 'button';
  found.addEventListener('click', () => change({ view: 'captures', subject: name }));
  return found;
};
const shares = row => {
  const bar = make('div', undefined, 'share');
  row.levels.forEach((count, k) => {
    const part = make('i', undefined, LEVELS[k]);
    part.style.width = 100 * count / row.count + '%';
    bar.append(part);
  });
  bar.title = LEVELS.map((level, k) => `${row.levels[k]} ${level}`).join(', ');
  return bar;
};

// Columns: key to sort by, heading, what a cell holds, whether it is a number.
const COLUMNS = {
  captures: [
    ['', '', image, false], ['name', 'Capture', named, false], ['subject', 'Subject', row => chosen(row.subject), false],
    ['level', 'Verdict', pill, false], ['error', 'Error', row => number(row.error, 1, ' mm'), true], ['p95', '95 % below', row => number(row.p95, 1, ' mm'), true],
    ['seconds', 'Duration', row => duration(row.seconds), true], ['frames', 'Frames', row => number(row.frames, 0), true], ['markers', 'Markers', row => number(row.markers, 0), true],
    ['suspects', 'Suspects', row => number(row.suspects, 0), true], ['height', 'Height', row => number(row.height, 0, ' cm', 100), true],
    ['mass', 'Mass', row => number(row.mass, 0, ' kg'), true], ['layout', 'Layout', row => make('span', row.layout), false],
  ],
  subjects: [
    ['', '', image, false], ['name', 'Subject', row => chosen(row.name), false], ['count', 'Captures', row => number(row.count, 0), true],
    ['good', 'Verdicts', shares, false], ['error', 'Error', row => number(row.error, 1, ' mm'), true], ['frames', 'Frames', row => number(row.frames, 0), true],
    ['height', 'Height', row => number(row.height, 0, ' cm', 100), true], ['mass', 'Mass', row => number(row.mass, 0, ' kg'), true], ['waist', 'Waist', row => number(row.waist, 0, ' cm', 100), true],
  ],
};

const START = { view: 'captures', levels: '', subject: '', q: '', least: '', suspects: '', sort: 'name' };
let state = { ...START }, found = [];

function parsed() {
  const given = Object.fromEntries(new URLSearchParams(location.hash.slice(1)));
  const known = Object.fromEntries(Object.entries(given).filter(([key]) => key in START));
  state = { ...START, ...known };
  if (!(state.view in COLUMNS)) state.view = 'captures';
}

function change(what) {
  state = { ...state, ...what };
  const changed = Object.entries(state).filter(([key, value]) => value !== START[key]);
  history.replaceState(null, '', '#' + new URLSearchParams(changed));
  show();
}

function matches(row) {
  if (state.q && !state.q.toLowerCase().split(/\s+/).every(word => row.text.includes(word))) return false;
  if (state.view === 'subjects') return true;
  if (state.levels && !state.levels.split(',').includes(row.level)) return false;
  if (state.subject && row.subject !== state.subject) return false;
  if (state.least && !(row.error >= +state.least)) return false;
  return !state.suspects || row.suspects > 0;
}

function ordered(rows) {
  const down = state.sort.startsWith('-'), key = state.sort.replace(/^-/, ''), sign = down ? -1 : 1;
  const value = row => key === 'level' ? LEVELS.indexOf(row.level) : row[key];
  const collator = new Intl.Collator('en', { numeric: true });
  return rows.sort((a, b) => {
    const [x, y] = [value(a), value(b)];
    if (x === y) return 0;
    if (x === null || x === undefined) return 1;  // what is not known comes last, either way round
    if (y === null || y === undefined) return -1;
    return sign * (typeof x === 'string' ? collator.compare(x, y) : x - y);
  });
}

function heads() {
  const line = make('tr');
  for (const [key, text, , numeric] of COLUMNS[state.view]) {
    const cell = make('th', undefined, numeric ? 'number' : '');
    cell.scope = 'col';
    if (key) {
      const button = make('button', text);
      button.type = 'button';
      button.addEventListener('click', () => change({ sort: state.sort === key ? '-' + key : key }));
      cell.append(button);
      if (state.sort.replace(/^-/, '') === key) cell.setAttribute('aria-sort', state.sort.startsWith('-') ? 'descending' : 'ascending');
    }
    line.append(cell);
  }
  at('heads').replaceChildren(line);
}

function draw() {
  const scroller = at('scroller'), columns = COLUMNS[state.view];
  const first = Math.max(0, Math.floor(scroller.scrollTop / HEIGHT) - SPARE);
  const last = Math.min(found.length, Math.ceil((scroller.scrollTop + scroller.clientHeight) / HEIGHT) + SPARE);
  at('rows').replaceChildren(...found.slice(first, last).map(row => {
    const line = make('tr');
    columns.forEach(([key, , content, numeric], k) => {
      const cell = make(k === 1 ? 'th' : 'td', undefined, numeric ? 'number' : key ? '' : 'picture');
      cell.append(content(row));
      if (key === 'layout' || key === 'subject') cell.title = row[key];
      line.append(cell);
    });
    return line;
  }));
  const height = (id, count) => { at(id).hidden = !count; at(id).rows[0].cells[0].style.height = count * HEIGHT + 'px'; };
  height('above', first);
  height('below', found.length - last);
}

function show() {
  const all = state.view === 'captures' ? captures : subjects;
  found = ordered(all.filter(matches));
  document.querySelectorAll('[data-view]').forEach(button => button.setAttribute('aria-pressed', button.dataset.view === state.view));
  document.querySelectorAll('.captures-only').forEach(part => { part.hidden = state.view !== 'captures'; part.style.display = part.hidden ? 'none' : ''; });
  document.querySelectorAll('[data-level]').forEach(button => button.setAttribute('aria-pressed', state.levels.split(',').includes(button.dataset.level)));
  for (const [id, key] of [['search', 'q'], ['subject', 'subject'], ['least', 'least']]) if (at(id).value !== state[key]) at(id).value = state[key];
  at('suspects').checked = Boolean(state.suspects);
  at('shown').textContent = found.length === all.length ? '' : `${number(found.length, 0)} of ${number(all.length, 0)} shown`;
  document.body.dataset.shown = found.length;
  heads();
  at('scroller').scrollTop = 0;
  draw();
}

function begin() {
  const counts = LEVELS.map(level => captures.filter(row => row.level === level).length);
  const frames = captures.reduce((sum, row) => sum + (row.frames || 0), 0), hours = captures.reduce((sum, row) => sum + (row.seconds || 0), 0) / 3600;
  const s = (count, word) => `${number(count, 0)} ${word}${count === 1 ? '' : 's'}`;
  at('facts').textContent = `${s(captures.length, 'capture')} of ${s(subjects.length, 'subject')}, ${s(frames, 'frame')}, ${hours < 1 ? number(60 * hours, 1, ' minutes') : number(hours, 1, ' hours')}`;
  LEVELS.forEach((level, k) => {
    const button = make('button');
    button.type = 'button';
    button.dataset.level = level;
    button.append(make('i', undefined, level), `${level} `, make('b', number(counts[k], 0)));
    button.addEventListener('click', () => {
      const on = new Set(state.levels.split(',').filter(Boolean));
      on.has(level) ? on.delete(level) : on.add(level);
      change({ levels: [...on].join(',') });
    });
    at('levels').append(button);
  });
  for (const row of subjects) {
    const option = make('option', `${row.name} (${row.count})`);
    option.value = row.name;
    at('subject').append(option);
  }
  document.querySelectorAll('[data-view]').forEach(button => button.addEventListener('click', () => change({ view: button.dataset.view, sort: 'name' })));
  for (const [id, key] of [['search', 'q'], ['subject', 'subject'], ['least', 'least']]) at(id).addEventListener('input', event => change({ [key]: event.target.value }));
  at('suspects').addEventListener('change', event => change({ suspects: event.target.checked ? '1' : '' }));
  at('reset').addEventListener('click', () => change({ ...START, view: state.view }));
  let waiting = false;
  at('scroller').addEventListener('scroll', () => {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; draw(); });
  });
  addEventListener('resize', draw);
  addEventListener('hashchange', () => { parsed(); show(); });
  parsed();
  show();
}

begin();
