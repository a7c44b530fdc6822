#version 460
// One triangle over the whole window.
void main() {
    vec2 ndc = vec2(gl_VertexIndex & 1, gl_VertexIndex >> 1) * 4.0 - 1.0;
    gl_Position = vec4(ndc, 0.0, 1.0);
}
