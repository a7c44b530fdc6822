// The sky, and the way from linear radiance to a display value. Server and client share this file, so that
// the background drawn by the client and the one of the ground truth are the same.
#ifndef ENVIRONMENT_GLSL
#define ENVIRONMENT_GLSL

vec3 sky_radiance(vec3 zenith, vec3 horizon, vec3 nadir, vec3 direction) {
    float up = clamp(direction.y, -1.0, 1.0);
    return up >= 0.0 ? mix(horizon, zenith, sqrt(up)) : mix(horizon, nadir, sqrt(-up));
}

// ACES filmic curve, the fit of Narkowicz (2015). Radiance to linear display light in 0..1.
vec3 tone_map(vec3 x) {
    return clamp(x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14), 0.0, 1.0);
}

// IEC 61966-2-1, both ways.
vec3 srgb_from_linear(vec3 c) {
    return mix(12.92 * c, 1.055 * pow(max(c, vec3(0.0)), vec3(1.0 / 2.4)) - 0.055, greaterThan(c, vec3(0.0031308)));
}

vec3 linear_from_srgb(vec3 c) {
    return mix(c / 12.92, pow(max((c + 0.055) / 1.055, vec3(0.0)), vec3(2.4)), greaterThan(c, vec3(0.04045)));
}

// Full-range BT.709 (ITU-R BT.709-6, item 3), components 0..1 with chroma centred at 128/255.
vec3 ycbcr_from_rgb(vec3 rgb) {
    float y = dot(rgb, vec3(0.2126, 0.7152, 0.0722));
    return vec3(y, (rgb.b - y) / 1.8556 + 128.0 / 255.0, (rgb.r - y) / 1.5748 + 128.0 / 255.0);
}

// Luma of one colour, and chroma of another: what that differs in from its luma.
vec3 rgb_of_two(vec3 of_luma, vec3 of_chroma) {
    vec3 weights = vec3(0.2126, 0.7152, 0.0722);
    return of_chroma + dot(of_luma, weights) - dot(of_chroma, weights);
}

vec3 rgb_from_ycbcr(vec3 ycbcr) {
    float cb = ycbcr.y - 128.0 / 255.0, cr = ycbcr.z - 128.0 / 255.0;
    float r = ycbcr.x + 1.5748 * cr, b = ycbcr.x + 1.8556 * cb;
    return vec3(r, (ycbcr.x - 0.2126 * r - 0.0722 * b) / 0.7152, b);
}

#endif
