// Saves pictures and videos of canvases that are stacked on each other.

/** Saves bytes under a name. `dataset.saved` states what was saved, for tests. */
export function saveBlob(blob, name) {
  const link = document.createElement('a');
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  document.documentElement.dataset.saved = `${name} ${blob.size}`;
}

// Pixels of an image stay squares; the marks are drawn on the screen's own grid.
function stack(target, canvases) {
  const c = target.getContext('2d');
  for (const canvas of canvases) {
    c.imageSmoothingEnabled = canvas.width > target.width;
    c.drawImage(canvas, 0, 0, target.width, target.height);
  }
}

function fitted(canvases, least) {
  const [first] = canvases;
  const times = Math.max(1, Math.round(least / first.width));
  const made = document.createElement('canvas');
  made.width = first.width * times;
  made.height = first.height * times;
  return made;
}

/** Saves the picture as PNG. */
export function savePng(canvases, name) {
  const made = fitted(canvases, 768);
  stack(made, canvases);
  return new Promise((done, failed) => made.toBlob((blob) => {
    if (!blob) { failed(new Error('the browser makes no PNG')); return; }
    saveBlob(blob, name);
    done();
  }));
}

/** A recording of the pictures as WebM. */
export class Recorder {
  /** `canvases()` returns the stacked canvases of the time. */
  constructor(canvases, name) {
    const types = ['video/webm;codecs=vp9', 'video/webm;codecs=vp8', 'video/webm'];
    const type = typeof MediaRecorder === 'undefined' ? undefined : types.find((t) => MediaRecorder.isTypeSupported(t));
    if (!type) throw new Error('this browser records no WebM; save a GIF');
    this.canvases = canvases;
    this.made = fitted(canvases(), 512);
    stack(this.made, canvases());
    this.media = new MediaRecorder(this.made.captureStream(30), { mimeType: type, videoBitsPerSecond: 8e6 });
    const parts = [];
    this.media.ondataavailable = (event) => { if (event.data.size) parts.push(event.data); };
    this.ended = new Promise((done) => {
      this.media.onstop = () => { saveBlob(new Blob(parts, { type: 'video/webm' }), name); done(); };
    });
    this.media.start(500);
  }

  frame() { stack(this.made, this.canvases()); }

  stop() {
    if (this.media.state !== 'inactive') this.media.stop();
    return this.ended;
  }
}
