// Pictures and turntable videos of what the player shows, as files that the browser saves.
const TURN_SECONDS = 6;

class Recorder {
  constructor(player, name) {
    Object.assign(this, { player, name, recording: null });
    this.sheet = document.createElement('canvas');
  }
  // The body and the names over it, on one canvas.
  compose() {
    const { player, sheet } = this, { canvas } = player, names = player.root.querySelector('#names');
    player.draw();
    Object.assign(sheet, { width: canvas.width, height: canvas.height });
    const c = sheet.getContext('2d');
    c.drawImage(canvas, 0, 0);
    c.drawImage(names, 0, 0, sheet.width, sheet.height);
    return sheet;
  }
  picture() { this.compose().toBlob(blob => this.#save(blob, 'png')); }
  get canFilm() { return typeof MediaRecorder === 'function' && 'captureStream' in this.player.canvas; }
  // Once around the body, in motion where the player plays; a second call stops it.
  turntable(changed) {
    if (this.recording) return this.recording.stop();
    const { player } = this, { camera } = player, from = camera.yaw, parts = [];
    const film = new MediaRecorder(player.canvas.captureStream(30), { videoBitsPerSecond: 8e6 });
    this.recording = film;
    film.addEventListener('dataavailable', e => parts.push(e.data));
    film.addEventListener('stop', () => {
      this.recording = null;
      camera.yaw = from;
      player.redraw();
      changed();
      this.#save(new Blob(parts, { type: film.mimeType }), film.mimeType.includes('mp4') ? 'mp4' : 'webm');
    });
    film.start();
    changed();
    this.#turn(film, from, null);
  }
  #turn(film, from, began) {
    requestAnimationFrame(now => {
      if (this.recording !== film) return;
      const share = (now - (began ?? now)) / (1000 * TURN_SECONDS);
      if (share >= 1) return film.stop();
      this.player.camera.yaw = from + 2 * Math.PI * share;
      this.player.draw();
      this.#turn(film, from, began ?? now);
    });
  }
  #save(blob, ending) {
    if (!blob || !blob.size) return;
    const link = Object.assign(document.createElement('a'), { href: URL.createObjectURL(blob), download: `${this.name}.${ending}` });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 10000);
  }
}
