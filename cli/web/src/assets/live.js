// Keeps a page current: the server sends its content again whenever it changes. Only parts that
// differ are replaced, so that focus, selections and opened details elsewhere stay.
const main = document.getElementById('main');
const state = document.getElementById('state');
const last = new Map();

function parts(root) {
  return [...root.children].map((part, i) => [part.id || `${part.localName}-${i}`, part]);
}

for (const [key, part] of parts(main)) last.set(key, part.outerHTML);

function show(html) {
  const template = document.createElement('template');
  template.innerHTML = html;
  const fresh = parts(template.content);
  const held = new Map(parts(main));
  const focus = document.activeElement?.id;
  const scrolled = scrollY;
  let before = main.firstElementChild;
  for (const [key, part] of fresh) {
    const old = held.get(key);
    held.delete(key);
    const text = part.outerHTML;
    if (old && last.get(key) === text) {
      if (before === old) before = old.nextElementSibling;
      else main.insertBefore(old, before);
      continue;
    }
    last.set(key, text);
    if (old) {
      if (before === old) before = old.nextElementSibling;
      old.replaceWith(part);
    } else {
      main.insertBefore(part, before);
    }
  }
  for (const [key, part] of held) {
    last.delete(key);
    part.remove();
  }
  if (focus && document.activeElement === document.body) document.getElementById(focus)?.focus();
  if (scrollY !== scrolled) scrollTo(scrollX, scrolled);
}

const to = encodeURIComponent(location.pathname + location.search);
let source = null;

function follow() {
  source = new EventSource(`/live?to=${to}`);
  source.onopen = () => { state.textContent = 'live'; state.className = 'live'; };
  source.onmessage = (event) => show(event.data);
  source.onerror = () => {
    state.textContent = source.readyState === EventSource.CLOSED ? 'stopped' : 'reconnecting…';
    state.className = 'away';
  };
}

// A hidden tab asks for nothing.
document.addEventListener('visibilitychange', () => {
  if (document.hidden) { source?.close(); source = null; } else if (!source) follow();
});
addEventListener('pagehide', () => source?.close());
if (!document.hidden) follow();
