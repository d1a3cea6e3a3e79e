// Thin helpers over WebGL2.
class Program {
  constructor(gl, vertex, fragment) {
    this.gl = gl;
    this.handle = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader) || 'shader');
      gl.attachShader(this.handle, shader);
    }
    gl.linkProgram(this.handle);
    if (!gl.getProgramParameter(this.handle, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(this.handle) || 'link');
    this.uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(this.handle, gl.ACTIVE_UNIFORMS); i++) {
      const { name, type } = gl.getActiveUniform(this.handle, i);
      this.uniforms[name.replace('[0]', '')] = { type, place: gl.getUniformLocation(this.handle, name) };
    }
  }
  use(values) {
    const gl = this.gl;
    gl.useProgram(this.handle);
    for (const [name, value] of Object.entries(values)) {
      const uniform = this.uniforms[name];
      if (!uniform) continue;
      if (uniform.type === gl.FLOAT_MAT4) gl.uniformMatrix4fv(uniform.place, false, value);
      else if (uniform.type === gl.FLOAT_VEC3) gl.uniform3fv(uniform.place, value);
      else if (uniform.type === gl.FLOAT_VEC2) gl.uniform2fv(uniform.place, value);
      else if (uniform.type === gl.FLOAT) typeof value === 'number' ? gl.uniform1f(uniform.place, value) : gl.uniform1fv(uniform.place, value);
      else gl.uniform1i(uniform.place, value);
    }
  }
}

function buffer(gl, data, target = gl.ARRAY_BUFFER) {
  const handle = gl.createBuffer();
  gl.bindBuffer(target, handle);
  gl.bufferData(target, data, gl.STATIC_DRAW);
  return handle;
}

function texture(gl, unit, inner, width, height, format, type, data) {
  const handle = gl.createTexture();
  gl.activeTexture(gl.TEXTURE0 + unit);
  gl.bindTexture(gl.TEXTURE_2D, handle);
  gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  gl.texImage2D(gl.TEXTURE_2D, 0, inner, width, height, 0, format, type, data);
  for (const name of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, name, gl.NEAREST);
  for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
  return handle;
}

// Quads drawn many times with one record of floats an instance; `layout` lists the sizes of the record's parts.
class Instances {
  constructor(gl, layout) {
    this.gl = gl;
    this.size = layout.reduce((a, b) => a + b, 0);
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    buffer(gl, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]));
    gl.enableVertexAttribArray(0);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    this.records = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.records);
    let start = 0;
    layout.forEach((count, k) => {
      gl.enableVertexAttribArray(k + 1);
      gl.vertexAttribPointer(k + 1, count, gl.FLOAT, false, 4 * this.size, 4 * start);
      gl.vertexAttribDivisor(k + 1, 1);
      start += count;
    });
    gl.bindVertexArray(null);
    this.list = [];
  }
  clear() { this.list.length = 0; }
  add(...values) { for (const v of values) typeof v === 'number' ? this.list.push(v) : this.list.push(...v); }
  upload() {
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, this.records);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, new Float32Array(this.list), this.gl.DYNAMIC_DRAW);
  }
  draw() {
    if (!this.list.length) return;
    this.gl.bindVertexArray(this.array);
    this.gl.drawArraysInstanced(this.gl.TRIANGLE_STRIP, 0, 4, this.list.length / this.size);
  }
}
