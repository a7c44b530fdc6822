#version 460
// What is where in the client's picture: instance and distance along the view axis, one sample a pixel.
layout(location = 0) flat in uint instance;
layout(location = 0) out uint id; // FIRST_ID and up; 0 is background
layout(location = 1) out float distance_m;

void main() {
    id = FIRST_ID + instance;
    distance_m = 1.0 / gl_FragCoord.w;
}
