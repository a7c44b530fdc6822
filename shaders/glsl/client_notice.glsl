// What the stage of the notice reads.
#ifndef CLIENT_NOTICE_GLSL
#define CLIENT_NOTICE_GLSL

struct NoticeGpu {
    mat4 world_from_panel; // metres; the text lies in the panel's z = 0, its middle at the origin
    vec4 box_cells;        // left, top, right and bottom of what is drawn, in cells from the upper left of the text
    vec4 cell_extent_m;    // xy
    uvec4 text_cells;      // x columns, y rows
};
layout(std140, binding = 1) uniform Notice { NoticeGpu notice; };

#endif
