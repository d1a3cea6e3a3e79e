// An orbiting camera with mouse, touch and pinch.
const FOV = 0.56;

class Camera {
  constructor(canvas, changed) {
    this.canvas = canvas;
    this.changed = changed;
    this.pointers = new Map();
    this.pan = [0, 0, 0];
    this.set(0.5, 0.16, 4.4);
    canvas.addEventListener('pointerdown', e => this.#down(e));
    canvas.addEventListener('pointermove', e => this.#move(e));
    for (const name of ['pointerup', 'pointercancel', 'lostpointercapture']) {
      canvas.addEventListener(name, e => this.pointers.delete(e.pointerId));
    }
    canvas.addEventListener('contextmenu', e => e.preventDefault());
    canvas.addEventListener('wheel', e => this.#wheel(e), { passive: false });
  }
  set(yaw, pitch, distance) {
    Object.assign(this, { yaw, pitch, distance, pan: [0, 0, 0] });
    this.light = Vec.unit([Math.sin(yaw - 0.75), 1.15, Math.cos(yaw - 0.75)]); // from the viewer's left; stays while orbiting
  }
  matrices(target, aspect = this.canvas.width / this.canvas.height) {
    const focus = Vec.plus(target, this.pan), c = Math.cos(this.pitch);
    const eye = Vec.plus(focus, [Math.sin(this.yaw) * c, Math.sin(this.pitch), Math.cos(this.yaw) * c], this.distance);
    const projection = Mat.perspective(FOV, aspect, Math.max(0.02, this.distance * 0.02), this.distance + 60);
    const view = Mat.lookAt(eye, focus, [0, 1, 0]);
    return { eye, focus, viewProjection: Mat.multiply(projection, view), fov: FOV };
  }
  orbit(dx, dy) {
    this.yaw -= dx * 0.0065;
    this.pitch = clamp(this.pitch + dy * 0.0055, -1.2, 1.5);
    this.changed();
  }
  zoom(factor) {
    this.distance = clamp(this.distance * factor, 0.25, 40);
    this.changed();
  }
  move(dx, dy) {
    const scale = 2 * this.distance * Math.tan(FOV / 2) / this.canvas.clientHeight;
    const right = [Math.cos(this.yaw), 0, -Math.sin(this.yaw)], s = Math.sin(this.pitch);
    const up = [-Math.sin(this.yaw) * s, Math.cos(this.pitch), -Math.cos(this.yaw) * s];
    this.pan = Vec.plus(Vec.plus(this.pan, right, -dx * scale), up, dy * scale);
    this.changed();
  }
  #down(e) {
    this.canvas.focus({ preventScroll: true });
    this.canvas.setPointerCapture(e.pointerId);
    this.pointers.set(e.pointerId, [e.clientX, e.clientY]);
  }
  #move(e) {
    const last = this.pointers.get(e.pointerId);
    if (!last) return;
    const dx = e.clientX - last[0], dy = e.clientY - last[1];
    if (this.pointers.size === 2) this.#pinch(e, dx, dy);
    else if (e.shiftKey || e.buttons & 6) this.move(dx, dy);
    else this.orbit(dx, dy);
    this.pointers.set(e.pointerId, [e.clientX, e.clientY]);
  }
  #pinch(e, dx, dy) {
    const [id] = [...this.pointers.keys()].filter(key => key !== e.pointerId), other = this.pointers.get(id);
    const last = this.pointers.get(e.pointerId);
    const before = Math.hypot(last[0] - other[0], last[1] - other[1]);
    const after = Math.hypot(e.clientX - other[0], e.clientY - other[1]);
    this.zoom(before / Math.max(after, 1));
    this.move(dx / 2, dy / 2);
  }
  // The wheel scrolls the page until the picture has been clicked (or with Ctrl, as a pinch on a touchpad sends).
  #wheel(e) {
    if (!e.ctrlKey && document.activeElement !== this.canvas) return;
    e.preventDefault();
    this.zoom(Math.exp(clamp(e.deltaY, -120, 120) * (e.ctrlKey ? 0.008 : 0.0016)));
  }
}
