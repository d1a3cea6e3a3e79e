// A body on the graphics card: its mesh, skin weights and blend shapes; one scene may draw several.
class Skin {
  constructor(gl, arrays) {
    this.gl = gl;
    this.#mesh(arrays);
    this.#textures(arrays);
  }
  // Puts a pose where the shaders read it, for all that is drawn until another skin is used; gives the uniforms that say so.
  use(pose) {
    const gl = this.gl, weights = new Float32Array(16);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D, this.morphs);
    gl.activeTexture(gl.TEXTURE0);
    gl.bindTexture(gl.TEXTURE_2D, this.bones);
    if (this.pose !== pose || !this.kept) gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, 4, this.jointCount, gl.RGBA, gl.FLOAT, pose.bones);
    Object.assign(this, { pose, kept: true });
    this.morphScale.forEach((scale, k) => { weights[k] = scale * pose.weights[k]; });
    return {
      uBones: 0, uMorphs: 1, uJointCount: this.jointCount, uMorphCount: this.morphScale.length, uVertexCount: this.vertexCount,
      uMorphWeights: weights,
    };
  }
  // The pose has changed: the next use reads it again.
  forget() { this.kept = false; }
  draw() {
    const { gl } = this;
    gl.bindVertexArray(this.mesh);
    gl.enable(gl.CULL_FACE);
    gl.drawElements(gl.TRIANGLES, this.indexCount, this.indexType, 0);
    gl.disable(gl.CULL_FACE);
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
    this.painted = arrays.has('colours');
    if (this.painted) {
      buffer(gl, arrays.get('colours'));
      gl.enableVertexAttribArray(4);
      gl.vertexAttribPointer(4, 3, gl.UNSIGNED_BYTE, true, 0, 0);
    }
    buffer(gl, faces, gl.ELEMENT_ARRAY_BUFFER);
    gl.bindVertexArray(null);
  }
  #textures(arrays) {
    const gl = this.gl, morphs = arrays.get('morphs'), rows = Math.max(1, Math.ceil(morphs.length / 3 / 2048));
    this.jointCount = arrays.shape('restJoints')[0];
    this.morphScale = arrays.contents.morphs.scale;
    const padded = new Int8Array(rows * 2048 * 3);
    padded.set(morphs);
    this.morphs = texture(gl, 1, gl.RGB8I, 2048, rows, gl.RGB_INTEGER, gl.BYTE, padded);
    this.bones = texture(gl, 0, gl.RGBA32F, 4, this.jointCount, gl.RGBA, gl.FLOAT, null);
  }
}
