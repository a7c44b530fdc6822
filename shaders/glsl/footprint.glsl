// What a pixel of the display covers of a block: the change of texel coordinates with a pixel, where a patch is shaded in
// texels of its own. Twin: twin/footprint.rs.
#ifndef FOOTPRINT_GLSL
#define FOOTPRINT_GLSL

// Pixels that the picture of a head at `at` moves by as the surface moves by `step_m`, all in the space of the head, which
// looks along -z. Beside the view and behind it there is no picture: there a pixel is as small in all directions as it is
// in the view's corner.
vec2 pixels_of(vec3 at, vec3 step_m, vec2 pixels_per_tangent) {
    float distance_m = length(at), depth_m = -at.z;
    if (depth_m > EDGE_COSINE * distance_m) {
        return pixels_per_tangent * (step_m.xy + at.xy / depth_m * step_m.z) / depth_m;
    }
    vec3 n = distance_m > NEAR_M ? at / distance_m : vec3(0, 0, 1);
    vec3 a = normalize(cross(n, abs(n.y) < 0.9 ? vec3(0, 1, 0) : vec3(1, 0, 0))), b = cross(n, a);
    float density = max(pixels_per_tangent.x, pixels_per_tangent.y) / (EDGE_COSINE * max(distance_m, NEAR_M));
    return density * vec2(dot(a, step_m), dot(b, step_m));
}

// The inverse of the change of pixels with texels, by its singular values: no less than a texel in any direction, since the
// block cannot hold finer detail, and no more than MAX_TEXELS_PER_PIXEL, whatever is seen edge on.
mat2 texels_per_pixel(mat2 pixels_per_texel) {
    vec2 x = pixels_per_texel[0], y = pixels_per_texel[1];
    float xx = dot(x, x), yy = dot(y, y), xy = dot(x, y);
    float half_difference = 0.5 * (xx - yy), spread = sqrt(half_difference * half_difference + xy * xy);
    float largest = sqrt(max(0.5 * (xx + yy) + spread, 1e-20));
    float smallest = abs(determinant(pixels_per_texel)) / largest;
    // The direction in texels that is seen longest; any, where all are alike.
    vec2 along = half_difference >= 0.0 ? vec2(half_difference + spread, xy) : vec2(xy, spread - half_difference);
    along = dot(along, along) > 1e-20 * largest * largest ? normalize(along) : vec2(1, 0);
    vec2 across = vec2(-along.y, along.x);
    vec2 u = pixels_per_texel * along / largest, v = vec2(-u.y, u.x);
    if (determinant(pixels_per_texel) < 0.0) v = -v;
    vec2 texels = clamp(1.0 / max(vec2(largest, smallest), 1e-10), MIN_TEXELS_PER_PIXEL, MAX_TEXELS_PER_PIXEL);
    return outerProduct(along * texels.x, u) + outerProduct(across * texels.y, v);
}

#endif
