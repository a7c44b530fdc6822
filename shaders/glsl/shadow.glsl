// How much of the sun reaches a point, by the shadow map: one lookup for the atlas and for the ground truth.
// Needs `light` and `shadow_map`.
#ifndef SHADOW_GLSL
#define SHADOW_GLSL

// A 3x3 box of bilinearly weighted comparisons: sixteen texels by four gathers. What lies outside the map is lit: the
// map's edge is empty.
float sun_visibility(vec3 world_position, vec3 n) {
    if (light.shadow.z == 0.0) return 1.0;
    // The filter reaches two texels and their diagonal, 2.83, over a surface that is steeper the more it turns from
    // the sun: moved out along its normal by that, a plane never shades itself; and by half a texel for rounding.
    float cosine = dot(n, light.to_sun.xyz);
    float offset_texels = 0.5 + 2.83 * sqrt(clamp(1.0 - cosine * cosine, 0.0, 1.0));
    vec3 moved = world_position + n * offset_texels * light.shadow.y;
    vec3 at = (light.shadow_from_world * vec4(moved, 1.0)).xyz;
    at.z = max(at.z, 0.0); // behind all casters there is still ground to see: as deep as the empty map
    vec2 texel = at.xy * light.shadow.x - 0.5, first = floor(texel), f = texel - first;
    // Of four texels in a row, the outer ones count by how far the middle is from them.
    vec4 columns = vec4(1.0 - f.x, 1.0, 1.0, f.x), rows = vec4(1.0 - f.y, 1.0, 1.0, f.y);
    float lit = 0.0;
    for (int y = 0; y < 4; y += 2) {
        for (int x = 0; x < 4; x += 2) {
            vec4 depths = textureGather(shadow_map, (first + vec2(x, y)) / light.shadow.x);
            vec4 reached = vec4(greaterThanEqual(vec4(at.z), depths)); // lower left, lower right, upper right, upper left
            lit += rows[y + 1] * (columns[x] * reached.x + columns[x + 1] * reached.y)
                + rows[y] * (columns[x + 1] * reached.z + columns[x] * reached.w);
        }
    }
    return lit / 9.0;
}

#endif
