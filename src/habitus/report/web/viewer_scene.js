// Draws one moment: floor, bodies, markers, lines. Knows nothing of time or of buttons.
const SHADOW_SIZE = 1024, SHADOW_HALF = 1.9;

class Scene {
  // One body for each of the arrays given.
  constructor(canvas, ...bodies) {
    const gl = canvas.getContext('webgl2', { antialias: true, alpha: false, powerPreference: 'high-performance' });
    if (!gl) throw new Error('this browser offers no WebGL 2');
    this.canvas = canvas;
    this.gl = gl;
    this.programs = {
      body: new Program(gl, SKIN_VERTEX, BODY_FRAGMENT), shadow: new Program(gl, SKIN_VERTEX, SHADOW_FRAGMENT),
      floor: new Program(gl, FLOOR_VERTEX, FLOOR_FRAGMENT), marker: new Program(gl, MARKER_VERTEX, MARKER_FRAGMENT),
      line: new Program(gl, LINE_VERTEX, LINE_FRAGMENT),
    };
    this.markers = new Instances(gl, [4, 4, 1]);
    this.lines = new Instances(gl, [3, 3, 4, 1]);
    this.bones = new Instances(gl, [3, 3, 4, 1]);
    this.joints = new Instances(gl, [4, 4, 1]);
    this.skins = bodies.map(arrays => new Skin(gl, arrays));
    this.#shadow();
    this.#quad();
  }
  resize() {
    const scale = Math.min(window.devicePixelRatio || 1, 2);
    const width = Math.max(1, Math.round(this.canvas.clientWidth * scale));
    const height = Math.max(1, Math.round(this.canvas.clientHeight * scale));
    if (this.canvas.width !== width || this.canvas.height !== height) Object.assign(this.canvas, { width, height });
    return [width, height];
  }
  // view: viewProjection, eye, fov, focus, light, floor, colors, show {body, glass, skeleton}; bodies [{skin, pose {bones, weights},
  // albedo}]; part [left, bottom, width, height] of the canvas, in its pixels, where it is not all of it
  draw(view) {
    const gl = this.gl, part = view.part ?? [0, 0, this.canvas.width, this.canvas.height], shared = this.#shared(view, part);
    for (const { skin } of view.bodies) skin.forget();
    gl.disable(gl.BLEND);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    this.#drawShadow(view, shared);
    gl.viewport(...part);
    gl.enable(gl.SCISSOR_TEST);
    gl.scissor(...part);
    gl.clearColor(...view.colors.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (view.show.floor && view.eye[1] > view.floor + 0.02) this.#drawFloor(view, shared);
    for (const set of [this.markers, this.lines, this.bones, this.joints]) set.upload();
    const solid = view.show.body && !view.show.glass;
    if (solid) this.#drawBodies(view, shared, 1);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    this.#drawMarkers(shared, solid);
    if (view.show.body && view.show.glass) this.#drawGlass(view, shared);
    if (view.show.skeleton) this.#drawSkeleton(shared);
    gl.bindVertexArray(null);
    gl.disable(gl.SCISSOR_TEST);
  }
  #shared(view, part) {
    const center = [view.focus[0], Math.max(view.focus[1], view.floor + 0.6), view.focus[2]];
    const eye = Vec.plus(center, view.light, 5);
    const shadow = Mat.multiply(Mat.orthographic(SHADOW_HALF, 0.5, 10), Mat.lookAt(eye, center, [0, 1, 0]));
    const viewport = part.slice(2);
    const scale = viewport[1] / 2 / Math.tan(view.fov / 2);
    return {
      uViewProjection: view.viewProjection, uEye: view.eye, uLight: view.light, uShadowMatrix: shadow, uFloor: view.floor,
      uViewport: viewport, uScale: scale, uShadow: 2, uSmallest: 2.6 * Math.min(window.devicePixelRatio || 1, 2),
    };
  }
  #drawShadow(view, shared) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadowBuffer);
    gl.viewport(0, 0, SHADOW_SIZE, SHADOW_SIZE);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    if (view.show.body) {
      gl.enable(gl.POLYGON_OFFSET_FILL);
      gl.polygonOffset(1.5, 2);
      for (const { skin, pose } of view.bodies) {
        this.programs.shadow.use({ ...shared, ...skin.use(pose), uViewProjection: shared.uShadowMatrix });
        skin.draw();
      }
      gl.disable(gl.POLYGON_OFFSET_FILL);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }
  #drawFloor(view, shared) {
    const { background, floor, line, shadow } = view.colors, gl = this.gl, first = view.bodies[0].skin.use(view.bodies[0].pose);
    this.programs.floor.use({
      ...shared, ...first, uFocus: view.focus, uReach: view.reach, uBackground: background, uFloorColor: floor, uLine: line,
      uShadowDepth: view.show.body ? shadow : 0, uJointCount: view.show.body ? first.uJointCount : 0,
    });
    gl.bindVertexArray(this.quad);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }
  #drawBodies(view, shared, alpha) {
    const { albedo, sky, ground, key, guess } = view.colors;
    for (const { skin, pose, albedo: own } of view.bodies) {
      this.programs.body.use({
        ...shared, ...skin.use(pose), uAlbedo: own ?? albedo, uSky: sky, uGround: ground, uKey: key, uAlpha: alpha, uGuess: guess,
        uStripes: view.stripes ?? 1, uPainted: Number(skin.painted && Boolean(view.show.skin)),
      });
      skin.draw();
    }
  }
  #drawGlass(view, shared) {
    const gl = this.gl;
    gl.colorMask(false, false, false, false);
    this.#drawBodies(view, shared, 1);
    gl.colorMask(true, true, true, true);
    this.#drawBodies(view, shared, 0.42);
  }
  #drawMarkers(shared, solid) {
    const gl = this.gl, { line, marker } = this.programs;
    gl.depthMask(false);
    for (const [fade, compare] of solid ? [[0.28, gl.GREATER], [1, gl.LEQUAL]] : [[1, gl.LEQUAL]]) {
      gl.depthFunc(compare);
      line.use({ ...shared, uFade: fade });
      this.lines.draw();
      marker.use({ ...shared, uFade: fade });
      this.markers.draw();
    }
    gl.depthMask(true);
  }
  #drawSkeleton(shared) {
    this.gl.disable(this.gl.DEPTH_TEST);
    this.programs.line.use({ ...shared, uFade: 1 });
    this.bones.draw();
    this.programs.marker.use({ ...shared, uFade: 1 });
    this.joints.draw();
    this.gl.enable(this.gl.DEPTH_TEST);
  }
  #shadow() {
    const gl = this.gl;
    const depth = texture(gl, 2, gl.DEPTH_COMPONENT24, SHADOW_SIZE, SHADOW_SIZE, gl.DEPTH_COMPONENT, gl.UNSIGNED_INT, null);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_COMPARE_MODE, gl.COMPARE_REF_TO_TEXTURE);
    for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.LINEAR);
    this.shadowBuffer = gl.createFramebuffer();
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadowBuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.DEPTH_ATTACHMENT, gl.TEXTURE_2D, depth, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }
  #quad() {
    const gl = this.gl;
    this.quad = gl.createVertexArray();
    gl.bindVertexArray(this.quad);
    buffer(gl, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]));
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    gl.bindVertexArray(null);
  }
}
