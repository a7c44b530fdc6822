// Where the ID buffer's vertices are, both eyes at once. Included after the multiview extension was asked for.
#ifndef ID_BUFFER_VERTEX_GLSL
#define ID_BUFFER_VERTEX_GLSL
#include "id_buffer.glsl"
#define SAVED_VERTICES_BINDING 1
#define BOXES_BINDING 6
#include "saved.glsl"

layout(std430, binding = 0) readonly buffer Vertices { VertexGpu vertices[]; };
layout(std140, binding = 2) uniform Views { ViewGpu views[ID_BUFFER_VIEWS]; };
layout(location = 0) out vec3 lookup;
// The same pixels whichever shader places a vertex.
invariant gl_Position;

void place(uint vertex) {
    lookup = alpha_lookup(materials[material], vertices[vertex_base + vertex]);
    gl_Position = views[first_view + gl_ViewIndex].clip_from_world * vec4(saved_position(instance, position_base + vertex), 1.0);
}

#endif
