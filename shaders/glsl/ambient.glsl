// What the sky does to a surface: its mean over the cosine, and over the lobe of a rough reflection. The sky has three
// colours and depends on the height of a direction alone, so that each mean is three weights with the sum 1, and the
// nadir's is the zenith's for the direction upside down. The same in Rust, and how exact the fits are: src/ambient.rs.
#ifndef AMBIENT_GLSL
#define AMBIENT_GLSL

// Irradiance divided by pi: the zenith's weight for a normal of height `up`. What is odd in `up` is exact.
float zenith_in_irradiance(float up) {
    float square = up * up;
    return max(0.3055 + 0.4 * up + square * (0.0695 + 0.0235 * square), 0.0);
}

// Prefiltered radiance (Karis 2014: normal, view and reflection are one direction; GGX): the zenith's weight for a reflection
// of height `up`. A sharp root, half even and half odd, that roughness rounds.
float zenith_in_reflection(float up, float roughness) {
    float r2 = roughness * roughness, r4 = r2 * r2;
    vec3 r = vec3(r2, r2 * roughness, r4);
    float width_even = 1.3968 * r2 - 0.0745 * r4, width_odd = 2.4789 * r2 - 1.2259 * r4;
    float even = sqrt(sqrt(up * up + width_even * width_even + 1e-12));
    float odd = up / sqrt(sqrt(up * up + width_odd * width_odd + 1e-12));
    float weight = dot(r, vec3(-0.02108, -0.70798, 1.2977))
        + even * (0.5 + dot(r, vec3(0.0963, -0.76306, -0.06494)))
        + odd * (0.5 + dot(r, vec3(0.03796, 0.54777, -1.11835)))
        + up * (dot(r, vec3(-0.24412, 0.14341, 0.52646)) + up * dot(r, vec3(0.07422, 0.2719, -0.2196)));
    return max(weight, 0.0);
}

vec3 sky_mean(vec3 zenith, vec3 horizon, vec3 nadir, float of_zenith, float of_nadir) {
    return zenith * of_zenith + nadir * of_nadir + horizon * (1.0 - of_zenith - of_nadir);
}

vec3 sky_irradiance(vec3 zenith, vec3 horizon, vec3 nadir, float up) {
    return sky_mean(zenith, horizon, nadir, zenith_in_irradiance(up), zenith_in_irradiance(-up));
}

vec3 sky_reflection(vec3 zenith, vec3 horizon, vec3 nadir, float up, float roughness) {
    float of_zenith = zenith_in_reflection(up, roughness), of_nadir = zenith_in_reflection(-up, roughness);
    return sky_mean(zenith, horizon, nadir, of_zenith, of_nadir);
}

// Share of the light from where a surface reflects that it gives on: the fit of Karis (2014).
vec3 ambient_brdf(vec3 f0, float roughness, float n_dot_v) {
    vec4 r = roughness * vec4(-1.0, -0.0275, -0.572, 0.022) + vec4(1.0, 0.0425, 1.04, -0.04);
    float a004 = min(r.x * r.x, exp2(-9.28 * n_dot_v)) * r.x + r.y;
    vec2 ab = vec2(-1.04, 1.04) * a004 + r.zw;
    return f0 * ab.x + ab.y;
}

#endif
