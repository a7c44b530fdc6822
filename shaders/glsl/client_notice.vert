#version 460
#extension GL_GOOGLE_include_directive : require
#extension GL_EXT_multiview : require
// A panel with text in front of everything: what a person must know while the world stands still.
#include "client_geometry.glsl"
#include "client_notice.glsl"
layout(std140, binding = 0) uniform Eyes { EyesGpu eyes; };
layout(location = 0) out vec2 cell; // from the upper left of the text

void main() {
    vec2 corner = vec2(gl_VertexIndex & 1, gl_VertexIndex >> 1);
    cell = mix(notice.box_cells.xy, notice.box_cells.zw, corner);
    vec2 from_middle = cell - vec2(notice.text_cells.xy) * 0.5;
    vec2 at_m = from_middle * notice.cell_extent_m.xy * vec2(1.0, -1.0);
    gl_Position = eyes.clip_from_world[gl_ViewIndex] * (notice.world_from_panel * vec4(at_m, 0.0, 1.0));
}
