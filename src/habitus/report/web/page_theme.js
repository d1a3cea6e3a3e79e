// Light or dark: as the reader's system has it, as the address wishes (#theme=dark), or as the button says. Scripts that
// paint with colours of their own listen to the event 'theme' of the document. Errors are listed in data-errors.
const body = document.body;
window.addEventListener('error', e => { body.dataset.errors = `${body.dataset.errors || ''}${e.message}; `; });
{
  const root = document.documentElement, system = matchMedia('(prefers-color-scheme: dark)');
  const changed = () => document.dispatchEvent(new Event('theme'));
  const follow = () => {
    const wish = new URLSearchParams(location.hash.slice(1)).get('theme');
    if (wish) root.dataset.theme = wish === 'dark' ? 'dark' : 'light';
  };
  follow();
  window.addEventListener('hashchange', () => { follow(); changed(); });
  system.addEventListener('change', changed);
  document.getElementById('theme').addEventListener('click', () => {
    const now = root.dataset.theme || (system.matches ? 'dark' : 'light');
    root.dataset.theme = now === 'dark' ? 'light' : 'dark';
    changed();
  });
}
