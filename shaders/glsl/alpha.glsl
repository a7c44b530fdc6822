// The alpha test of passes that do not shade: one piece of code, for the same holes everywhere. Included after
// `textures`.
#ifndef ALPHA_GLSL
#define ALPHA_GLSL
#include "alpha_lookup.glsl"

// `lookup` is what vertices gave, interpolated.
bool is_cut_out(MaterialGpu m, vec3 lookup) {
    if (IS_MASKED_DRAW == 0 || m.alpha_cutoff == NO_ALPHA_CUTOFF) return false;
    float alpha = m.base_color.a * lookup.z;
    if (m.base_color_texture != NO_TEXTURE) alpha *= texture(textures[nonuniformEXT(m.base_color_texture)], lookup.xy).a;
    return alpha < m.alpha_cutoff;
}

#endif
