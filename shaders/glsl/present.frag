#version 460
#extension GL_GOOGLE_include_directive : require
// The rendered picture on the window, with figures over it.
#include "present.glsl"

layout(binding = 0) uniform sampler2D picture; // sRGB, of the window's size
layout(location = 0) out vec4 color;

void main() {
    color = presented(texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb);
}
