#version 460
// Both controllers: a colour a face.
layout(location = 0) flat in vec3 shade;
layout(location = 0) out vec4 color; // linear; the attachment is sRGB

void main() {
    color = vec4(shade, 1.0);
}
