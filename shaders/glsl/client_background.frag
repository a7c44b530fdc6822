#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_multiview : require
// Behind everything: the scene's environment, or a waiting room of gradient, floor grid and text before there is one.
#include "environment.glsl"
#include "client_geometry.glsl"

struct BackdropGpu {
    vec4 zenith; // rgb radiance
    vec4 horizon;
    vec4 nadir;
    mat4 panel_from_space; // metres; the text lies in the panel's z = 0, its middle at the origin
    uvec4 text_cells;      // x columns, y rows
    vec4 cell_extent_m;    // xy
};
layout(std140, binding = 0) uniform Eyes { EyesGpu eyes; };
layout(std140, binding = 1) uniform Backdrop { BackdropGpu backdrop; };
layout(std430, binding = 2) readonly buffer Text { uint text[]; };
// 0 where there is no waiting room: devices that evaluate both sides of a branch are spared its text.
layout(constant_id = 0) const uint IS_WAITING_ROOM = 1;
layout(location = 0) in vec2 ndc;
layout(location = 0) out vec4 color; // linear; the attachment is sRGB

#include "text.glsl"

float panel_coverage(vec3 eye, vec3 direction) {
    vec3 origin = (backdrop.panel_from_space * vec4(eye, 1.0)).xyz;
    vec3 along = (backdrop.panel_from_space * vec4(direction, 0.0)).xyz;
    float t = -origin.z / along.z;
    vec2 cells = vec2(backdrop.text_cells.xy);
    vec2 at = (origin.xy + along.xy * t) / backdrop.cell_extent_m.xy * vec2(1.0, -1.0) + cells * 0.5;
    vec2 third = fwidth(at) / 3.0;
    if (!(t > 0.0) || any(lessThan(at, -third)) || any(greaterThan(at, cells + third))) return 0.0;
    return text_coverage(at, third, backdrop.text_cells.xy);
}

// Lines a metre apart on the stage's floor, as wide as a pixel at least, fading out with distance.
float floor_coverage(vec3 eye, vec3 direction) {
    float t = -eye.y / min(direction.y, -1e-4);
    vec2 at = eye.xz + direction.xz * t;
    vec2 width = max(fwidth(at), vec2(0.01));
    vec2 line = 1.0 - clamp(abs(fract(at - 0.5) - 0.5) / width, 0.0, 1.0);
    vec2 resolved = clamp(0.5 / width, 0.0, 1.0);
    float fade = direction.y < 0.0 && t > 0.0 ? exp(-t * 0.15) : 0.0;
    return max(line.x * resolved.x, line.y * resolved.y) * fade;
}

void main() {
    vec3 direction = normalize((eyes.space_from_clip_direction[gl_ViewIndex] * vec4(ndc, 1.0, 0.0)).xyz);
    vec3 sky = sky_radiance(backdrop.zenith.rgb, backdrop.horizon.rgb, backdrop.nadir.rgb, direction);
    color = vec4(tone_map(sky), 1.0);
    if (IS_WAITING_ROOM != 0) {
        vec3 eye = eyes.space_eye[gl_ViewIndex].xyz;
        color.rgb = mix(color.rgb, vec3(0.45), floor_coverage(eye, direction) * 0.6);
        color.rgb = mix(color.rgb, vec3(0.9), panel_coverage(eye, direction));
    }
}
