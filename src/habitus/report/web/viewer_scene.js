// Draws one moment: floor, body, markers, lines. Knows nothing of time or of buttons.
const SHADOW_SIZE = 1024, SHADOW_HALF = 1.9;

class Scene {
  constructor(canvas, arrays) {
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
    this.#mesh(arrays);
    this.#textures(arrays);
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
  // view: viewProjection, eye, fov, focus, light, pose {bones, weights}, floor, colors, show {body, glass, skeleton}
  draw(view) {
    const gl = this.gl, shared = this.#shared(view);
    gl.activeTexture(gl.TEXTURE0);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 4, this.jointCount, gl.RGBA, gl.FLOAT, view.pose.bones);
    gl.disable(gl.BLEND);
    gl.enable(gl.DEPTH_TEST);
    gl.depthFunc(gl.LEQUAL);
    this.#drawShadow(view, shared);
    gl.viewport(0, 0, this.canvas.width, this.canvas.height);
    gl.clearColor(...view.colors.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (view.show.floor && view.eye[1] > view.floor + 0.02) this.#drawFloor(view, shared);
    for (const set of [this.markers, this.lines, this.bones, this.joints]) set.upload();
    if (view.show.body && !view.show.glass) this.#drawBody(view, shared, 1);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    this.#drawMarkers(shared, view.show.body && !view.show.glass);
    if (view.show.body && view.show.glass) this.#drawGlass(view, shared);
    if (view.show.skeleton) this.#drawSkeleton(shared);
    gl.bindVertexArray(null);
  }
  #shared(view) {
    const center = [view.focus[0], Math.max(view.focus[1], view.floor + 0.6), view.focus[2]];
    const eye = Vec.plus(center, view.light, 5);
    const shadow = Mat.multiply(Mat.orthographic(SHADOW_HALF, 0.5, 10), Mat.lookAt(eye, center, [0, 1, 0]));
    const viewport = [this.canvas.width, this.canvas.height];
    const scale = viewport[1] / 2 / Math.tan(view.fov / 2);
    return {
      uViewProjection: view.viewProjection, uEye: view.eye, uLight: view.light, uShadowMatrix: shadow, uFloor: view.floor,
      uViewport: viewport, uScale: scale, uBones: 0, uMorphs: 1, uShadow: 2, uJointCount: this.jointCount,
      uMorphCount: this.morphScale.length, uVertexCount: this.vertexCount,
      uMorphWeights: this.#morphWeights(view.pose), uSmallest: 2.6 * Math.min(window.devicePixelRatio || 1, 2),
    };
  }
  #morphWeights(pose) {
    const weights = new Float32Array(16);
    this.morphScale.forEach((scale, k) => { weights[k] = scale * pose.weights[k]; });
    return weights;
  }
  #drawShadow(view, shared) {
    const gl = this.gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.shadowBuffer);
    gl.viewport(0, 0, SHADOW_SIZE, SHADOW_SIZE);
    gl.clear(gl.DEPTH_BUFFER_BIT);
    if (view.show.body) {
      gl.enable(gl.POLYGON_OFFSET_FILL);
      gl.polygonOffset(1.5, 2);
      this.programs.shadow.use({ ...shared, uViewProjection: shared.uShadowMatrix });
      this.#drawMesh();
      gl.disable(gl.POLYGON_OFFSET_FILL);
    }
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }
  #drawFloor(view, shared) {
    const { background, floor, line, shadow } = view.colors, gl = this.gl;
    this.programs.floor.use({
      ...shared, uFocus: view.focus, uReach: view.reach, uBackground: background, uFloorColor: floor, uLine: line,
      uShadowDepth: view.show.body ? shadow : 0, uJointCount: view.show.body ? this.jointCount : 0,
    });
    gl.bindVertexArray(this.quad);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }
  #drawBody(view, shared, alpha) {
    const { albedo, sky, ground, key } = view.colors;
    this.programs.body.use({ ...shared, uAlbedo: albedo, uSky: sky, uGround: ground, uKey: key, uAlpha: alpha });
    this.#drawMesh();
  }
  #drawGlass(view, shared) {
    const gl = this.gl;
    gl.colorMask(false, false, false, false);
    this.#drawBody(view, shared, 1);
    gl.colorMask(true, true, true, true);
    this.#drawBody(view, shared, 0.42);
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
  #drawMesh() {
    this.gl.bindVertexArray(this.mesh);
    this.gl.enable(this.gl.CULL_FACE);
    this.gl.drawElements(this.gl.TRIANGLES, this.indexCount, this.indexType, 0);
    this.gl.disable(this.gl.CULL_FACE);
  }
  #mesh(arrays) {
    const gl = this.gl, vertices = arrays.points('vertices'), faces = arrays.get('faces');
    this.vertexCount = vertices.length / 3;
    this.indexCount = faces.length;
    this.indexType = faces instanceof Uint16Array ? gl.UNSIGNED_SHORT : gl.UNSIGNED_INT;
    this.mesh = gl.createVertexArray();
    gl.bindVertexArray(this.mesh);
    const floats = [vertices, vertexNormals(vertices, faces)];
    floats.forEach((data, k) => { buffer(gl, data); gl.enableVertexAttribArray(k); gl.vertexAttribPointer(k, 3, gl.FLOAT, false, 0, 0); });
    buffer(gl, arrays.get('joints'));
    gl.enableVertexAttribArray(2);
    gl.vertexAttribIPointer(2, 4, gl.UNSIGNED_SHORT, 0, 0);
    buffer(gl, arrays.get('weights'));
    gl.enableVertexAttribArray(3);
    gl.vertexAttribPointer(3, 4, gl.UNSIGNED_SHORT, true, 0, 0);
    buffer(gl, faces, gl.ELEMENT_ARRAY_BUFFER);
    gl.bindVertexArray(null);
  }
  #textures(arrays) {
    const gl = this.gl, morphs = arrays.get('morphs'), rows = Math.max(1, Math.ceil(morphs.length / 3 / 2048));
    this.jointCount = arrays.shape('restJoints')[0];
    this.morphScale = arrays.contents.morphs.scale;
    const padded = new Int8Array(rows * 2048 * 3);
    padded.set(morphs);
    texture(gl, 1, gl.RGB8I, 2048, rows, gl.RGB_INTEGER, gl.BYTE, padded);
    texture(gl, 0, gl.RGBA32F, 4, this.jointCount, gl.RGBA, gl.FLOAT, null);
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
