// Keeps a page current: the server sends its content again whenever it changes. Only parts that
// differ are replaced, so that focus, selections and opened details elsewhere stay. While the
// coordinator is away, the last content stays. Where the server follows no more pages, the page asks
// for its content every few seconds, and for events again after a growing delay.
const POLL = 5000;
const LONGEST = 60000;
const main = document.getElementById('main');
const state = document.getElementById('state');
const last = new Map();

function parts(root) {
  return [...root.children].map((part, i) => [part.id || `${part.localName}-${i}`, part]);
}

for (const [key, part] of parts(main)) last.set(key, part.outerHTML);

// A selector that finds an element again after its part was replaced: cells of tasks have no ids.
function place(element) {
  if (element?.id) return `#${CSS.escape(element.id)}`;
  const link = element?.closest?.('.grid a')?.getAttribute('href');
  return link ? `.grid a[href="${CSS.escape(link)}"]` : null;
}

function show(html) {
  const template = document.createElement('template');
  template.innerHTML = html;
  const fresh = parts(template.content);
  const held = new Map(parts(main));
  const focus = place(document.activeElement);
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
  if (focus && document.activeElement === document.body) main.querySelector(focus)?.focus();
  if (scrollY !== scrolled) scrollTo(scrollX, scrolled);
}

const to = encodeURIComponent(location.pathname + location.search);
// An error page has neither the title nor the scripts of the page that follows it.
const failed = document.getElementById('problem') !== null;
let source = null, retry = null, poll = null, delay = 0;

function say(kind, text, why = '') {
  state.className = kind;
  state.textContent = text;
  state.title = why;
}

function renew(html) {
  if (failed) location.reload();
  else show(html);
}

function stop() {
  source?.close();
  source = null;
  clearTimeout(retry);
  clearInterval(poll);
  retry = poll = null;
}

function follow() {
  stop();
  source = new EventSource(`/live?to=${to}`);
  source.onmessage = (event) => { delay = 0; say('live', 'live'); renew(event.data); };
  source.addEventListener('away', (event) => { delay = 0; say('away', 'coordinator away', event.data); });
  source.onerror = () => {
    if (source.readyState === EventSource.CLOSED) refused();
    else say('away', 'reconnecting…');
  };
}

const page = async (reply) => new DOMParser().parseFromString(await reply.text(), 'text/html');

// An event source does not have the reason of its end: a second request has.
async function refused() {
  stop();
  delay = Math.min(LONGEST, Math.max(2000, 2 * delay));
  retry = setTimeout(follow, delay);
  poll = setInterval(ask, POLL);
  ask();
  const mine = retry;
  const next = `next try in ${delay / 1000} s`;
  try {
    const reply = await fetch(`/live?to=${to}`);
    if (reply.ok) { reply.body.cancel(); if (retry === mine) follow(); return; }
    const why = (await page(reply)).querySelector('.problem p')?.textContent ?? `the server answers ${reply.status}`;
    if (retry === mine) say('away', `not live: ${why}; ${next}`);
  } catch {
    if (retry === mine) say('away', `the server is away; ${next}`);
  }
}

// The content without events.
async function ask() {
  const mine = poll;
  const reply = await fetch(location.href).catch(() => null);
  if (!reply?.ok) return;
  const html = (await page(reply)).getElementById('main')?.innerHTML;
  if (html && poll === mine) renew(html);
}

// A hidden page asks for nothing.
document.addEventListener('visibilitychange', () => {
  if (document.hidden) stop(); else if (!source && !retry) follow();
});
addEventListener('pagehide', stop);
if (!document.hidden) follow();
