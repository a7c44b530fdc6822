#version 460
// What is where in the client's picture: instance and distance along the view axis, one sample a pixel.
layout(location = 0) flat in uint instance;
layout(location = 0) out uint instance_number; // + 1; 0 is background
layout(location = 1) out float distance_m;

void main() {
    instance_number = instance + 1;
    distance_m = 1.0 / gl_FragCoord.w;
}
