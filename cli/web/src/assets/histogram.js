// A pixel's histogram on a canvas: bars of one, two, and three and more bounces, the predicted times
// of each spot, and the time that the player shows.
const METRES_PER_NS = 0.299792458;

function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** Fits the canvas to its place on the screen, and returns its context and size in CSS pixels. */
export function fit(canvas) {
  const ratio = Math.min(3, devicePixelRatio || 1);
  const width = canvas.clientWidth, height = canvas.clientHeight;
  const [w, h] = [Math.round(width * ratio), Math.round(height * ratio)];
  if (canvas.width !== w || canvas.height !== h) { canvas.width = w; canvas.height = h; }
  const context = canvas.getContext('2d');
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

export class Histogram {
  constructor(canvas, facts) {
    this.canvas = canvas;
    this.facts = facts;
    this.pixel = null;
  }

  bin(path) { return (path - this.facts.start_m) / this.facts.bin_m; }
  ns(bin) { return (this.facts.start_m + bin * this.facts.bin_m) / METRES_PER_NS; }

  /** Sets the answer of the server for a pixel, and classifies its bins. */
  set(pixel) {
    this.pixel = pixel;
    const { h } = pixel;
    const kinds = new Uint8Array(h.length);
    const mark = (path, kind) => {
      const bin = Math.floor(this.bin(path));
      for (let b = bin - 1; b <= bin + 1; b++) if (b >= 0 && b < h.length && kinds[b] < kind) kinds[b] = kind;
    };
    // Selected light has no shares, so its bars are of one colour.
    if (pixel.whole) {
      for (const spot of pixel.two) if (spot.lit) mark(spot.path_m, 1);
      if (pixel.one) mark(pixel.one.path_m, 2);
    }
    this.kinds = kinds;
    // What the render tells apart needs no prediction. The remainder of rounding is no light.
    const most = h.reduce((a, b) => Math.max(a, b), 0);
    this.parts = pixel.parts && [pixel.parts[1], pixel.parts[0],
      h.map((v, b) => { const one = v - pixel.parts[0][b] - pixel.parts[1][b]; return one > 0.02 * most ? one : 0; })];
    const first = h.findIndex((v) => v > 0), end = h.length - [...h].reverse().findIndex((v) => v > 0);
    this.lit = first < 0 ? [0, h.length] : [Math.max(0, first - 4), Math.min(h.length, end + 4)];
  }

  /** A summary for the page and for screen readers. */
  words() {
    const { h, one, two, whole } = this.pixel;
    const sum = h.reduce((a, b) => a + b, 0);
    if (sum === 0) return 'no light';
    let peak = 0;
    for (let b = 1; b < h.length; b++) if (h[b] > h[peak]) peak = b;
    const height = `peak ${h[peak].toPrecision(3)} at ${this.ns(peak + 0.5).toFixed(2)} ns`;
    if (!whole) return height;
    const of = [0, 0, 0];
    if (this.parts) this.parts.forEach((part, kind) => { of[kind] = part.reduce((a, b) => a + b, 0); });
    else h.forEach((v, b) => { of[this.kinds[b]] += v; });
    const share = (x) => `${(100 * x / sum).toFixed(0)} %`;
    const lit = two.filter((spot) => spot.lit).length;
    const from = lit ? ` from ${lit} of ${two.length} spots` : '';
    if (this.parts) return `${height} · rendered apart: ${share(of[2])} one bounce, ` +
      `${share(of[1])} two bounces${from}, ${share(of[0])} three and more`;
    return height + (one ? ` · ${share(of[2])} at the time of one bounce (spot ${one.spot})` : '') +
      (lit ? ` · ${share(of[1])} at times of two bounces,${from}` : ' · no times of two bounces: no spot lights this pixel');
  }

  /** What predictions say of the pixel, a line each. */
  seen() {
    const { seen, values, two } = this.pixel;
    const truth = new Set(two.filter((spot) => spot.lit).map((spot) => spot.spot));
    return (seen ?? []).map((p) => {
      const who = `${p.flash ? 'One flash' : 'Predicted'} (${p.place})`;
      if (p.problem) return `${who}: not readable: ${p.problem}`;
      const lit = p.lit.filter((s) => s.share >= 0.5).map((s) => s.spot);
      const missed = [...truth].filter((s) => !lit.includes(s)), wrong = lit.filter((s) => !truth.has(s));
      const parts = [];
      if (p.range_m !== null) parts.push(`${p.range_m.toFixed(2)} m` + (values.range_m ? ` (true ${values.range_m.toFixed(2)} m)` : ''));
      if (p.lit.length) parts.push(`lit by ${lit.length} of ${p.lit.length} spots` + (missed.length ? `, misses ${missed.join(' ')}` : '') +
        (wrong.length ? `, adds ${wrong.join(' ')}` : missed.length ? '' : ', as in truth'));
      if (p.confidence !== null) parts.push(`confidence ${(100 * p.confidence).toFixed(0)} %`);
      if (p.mirror !== null && p.mirror >= 0.5) parts.push('a mirror');
      return `${who}: ${parts.join(' · ')}`;
    });
  }

  range(zoom) { return zoom && this.pixel ? this.lit : [0, this.facts.bins]; }

  /** The bin under a horizontal place on the canvas. */
  binAt(x, zoom) {
    const [lo, hi] = this.range(zoom);
    return lo + (x - LEFT) / Math.max(1, this.canvas.clientWidth - LEFT - 4) * (hi - lo);
  }

  draw({ log, zoom, time, shutter }) {
    const { context: c, width, height } = fit(this.canvas);
    c.font = '11px system-ui, sans-serif';
    c.fillStyle = css('--dim');
    if (!this.pixel) return;
    const { h, two, one } = this.pixel;
    const [lo, hi] = this.range(zoom);
    const bottom = height - 18, top = 16, wide = width - LEFT - 4;
    const x = (bin) => LEFT + (bin - lo) / (hi - lo) * wide;
    let most = 0;
    for (let b = lo; b < hi; b++) most = Math.max(most, h[b]);
    const floor = most / 1e4;
    const y = (v) => {
      if (most === 0) return bottom;
      const t = log ? Math.log(Math.max(v, floor) / floor) / Math.log(most / floor) : v / most;
      return bottom - t * (bottom - top);
    };
    // The shown bins, in the axes.
    const [from, to] = [time, time + shutter].map((bin) => Math.min(LEFT + wide, Math.max(LEFT, x(bin))));
    c.globalAlpha = 0.2;
    c.fillStyle = css('--text');
    if (to > from) c.fillRect(from, top, Math.max(1.5, to - from), bottom - top);
    c.globalAlpha = 1;
    const colours = [css('--more'), css('--two'), css('--one')];
    const bar = (b, v, colour) => {
      if (v <= floor) return;
      c.fillStyle = colour;
      c.fillRect(x(b), y(v), Math.max(0.75, x(b + 1) - x(b)), bottom - y(v));
    };
    for (let b = lo; b < hi; b++) {
      if (!this.parts) { bar(b, h[b], colours[this.kinds[b]]); continue; }
      // The greatest part is behind the others.
      const parts = this.parts.map((part, kind) => [part[b], kind]).sort((p, q) => q[0] - p[0]);
      for (const [v, kind] of parts) bar(b, v, colours[kind]);
    }
    c.lineWidth = 1;
    const line = (path, colour, dash, name) => {
      const bin = this.bin(path);
      if (bin < lo || bin > hi) return;
      c.strokeStyle = colour;
      c.setLineDash(dash);
      c.beginPath();
      c.moveTo(x(bin), top - 3);
      c.lineTo(x(bin), bottom);
      c.stroke();
      c.setLineDash([]);
      c.fillStyle = colour;
      if (name !== null) c.fillText(name, x(bin) - c.measureText(name).width / 2, top - 5);
    };
    c.globalAlpha = 0.9;
    let named = -Infinity;
    for (const spot of [...two].sort((a, b) => a.path_m - b.path_m)) {
      const place = x(this.bin(spot.path_m));
      const name = spot.lit && place - named > 16 ? String(spot.spot) : null;
      if (name !== null) named = place;
      line(spot.path_m, spot.lit ? css('--two') : css('--faint'), spot.lit ? [2, 2] : [1, 4], name);
    }
    if (one) line(one.path_m, css('--one'), [], null);
    c.globalAlpha = 1;
    c.strokeStyle = css('--line');
    c.strokeRect(LEFT - 0.5, top + 0.5, wide + 1, bottom - top);
    // Where predictions look for light: filled for a spot that they judge to light the pixel.
    const flash = this.pixel.seen?.find((p) => p.lit?.length);
    for (const spot of flash?.lit ?? []) {
      const bin = this.bin(spot.path_m);
      if (bin < lo || bin > hi) continue;
      c.beginPath();
      c.moveTo(x(bin), bottom - 6); c.lineTo(x(bin) - 3.5, bottom); c.lineTo(x(bin) + 3.5, bottom); c.closePath();
      c.lineWidth = 1; c.strokeStyle = c.fillStyle = css('--done');
      if (spot.share >= 0.5) c.fill(); else c.stroke();
    }
    c.fillStyle = css('--dim');
    const [start, end] = [this.ns(lo), this.ns(hi)];
    const step = round((end - start) / Math.max(2, Math.min(8, wide / 70)));
    for (let k = Math.ceil(start / step); k * step <= end; k++) {
      const place = LEFT + (k * step - start) / (end - start) * wide;
      c.fillRect(place - 0.5, bottom, 1, 4);
      const text = (k * step).toFixed(step < 1 ? 1 : 0);
      const half = c.measureText(text).width / 2;
      if (place + half < width - 18) c.fillText(text, place - half, height - 3);
    }
    c.fillText('ns', width - 14, height - 3);
    const short = (v) => (v === 0 || (v >= 0.001 && v < 1e4) ? v.toPrecision(2) : v.toExponential(1));
    c.fillText(short(most), 0, top + 8);
    c.fillText(log ? short(floor) : '0', 0, bottom);
  }
}

/** Rounds to 1, 2 or 5 times a power of ten, upwards. */
function round(x) {
  const power = 10 ** Math.floor(Math.log10(x));
  return power * [1, 2, 5, 10].find((n) => n * power >= x);
}

const LEFT = 48;
