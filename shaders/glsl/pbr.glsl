// The shading model, one piece of code for the atlas and for the ground truth.
// glTF 2.0 appendix B: Lambert + GGX with Smith-GGX visibility and Schlick Fresnel. Ambient light is the sky's, by the split
// sum of Karis (2014).
#ifndef PBR_GLSL
#define PBR_GLSL
#include "ambient.glsl"
#include "shadow.glsl"

struct Surface {
    vec3 world_position;
    vec3 world_normal;    // interpolated, towards the viewer's side
    vec3 world_tangent;
    float tangent_sign;
    vec2 uv;
    vec2 uv_dx;           // change of uv per pixel or texel
    vec2 uv_dy;
    vec2 uv1;
    vec2 uv1_dx;
    vec2 uv1_dy;
    vec4 color;           // of the vertices, 0..1
};

vec4 fetch(MaterialGpu m, uint slot, int texture_index, Surface s, vec4 absent) {
    if (texture_index == NO_TEXTURE) return absent;
    vec2 uv = slot_uv(m, slot, s.uv, s.uv1, 1.0);
    vec2 dx = slot_uv(m, slot, s.uv_dx, s.uv1_dx, 0.0), dy = slot_uv(m, slot, s.uv_dy, s.uv1_dy, 0.0);
    return textureGrad(textures[nonuniformEXT(texture_index)], uv, dx, dy);
}

vec4 base_color(MaterialGpu m, Surface s) {
    return m.base_color * s.color * fetch(m, BASE_COLOR_SLOT, m.base_color_texture, s, vec4(1.0));
}

vec3 mapped_normal(MaterialGpu m, Surface s) {
    vec3 n = normalize(s.world_normal);
    if (m.normal_texture == NO_TEXTURE) return n;
    vec3 t = s.world_tangent - n * dot(n, s.world_tangent);
    if (dot(t, t) < 1e-12) return n;
    t = normalize(t);
    vec3 b = cross(n, t) * s.tangent_sign;
    vec3 map = fetch(m, NORMAL_SLOT, m.normal_texture, s, vec4(0.5, 0.5, 1.0, 1.0)).xyz * 2.0 - 1.0;
    map.xy *= m.normal_scale;
    return normalize(map.x * t + map.y * b + map.z * n);
}

// Radiance towards v for an irradiance of 1 on a surface that faces l.
vec3 reflected(vec3 n, vec3 v, vec3 l, vec3 diffuse, vec3 f0, float roughness) {
    vec3 h = normalize(l + v);
    float n_l = max(dot(n, l), 0.0), n_v = max(dot(n, v), 1e-3);
    float n_h = max(dot(n, h), 0.0), v_h = max(dot(v, h), 0.0);
    float a = max(roughness * roughness, 1e-3), a2 = a * a;
    float d = n_h * n_h * (a2 - 1.0) + 1.0;
    float distribution = a2 / (3.14159265 * d * d);
    float visibility =
        0.5 / (n_l * sqrt(n_v * n_v * (1.0 - a2) + a2) + n_v * sqrt(n_l * n_l * (1.0 - a2) + a2) + 1e-5);
    vec3 fresnel = f0 + (1.0 - f0) * pow(1.0 - v_h, 5.0);
    return ((1.0 - fresnel) * diffuse / 3.14159265 + fresnel * distribution * visibility) * n_l;
}

// Sun and lamps. `facing` is the surface's own normal, without the normal map: what the shadow map knows. sun_reaches: below 0
// until it was looked up, for samples of one place to share.
vec3 direct_light(
    vec3 at, vec3 facing, vec3 n, vec3 v, vec3 diffuse, vec3 f0, float roughness, inout float sun_reaches) {
    vec3 sum = vec3(0.0);
    if (dot(n, light.to_sun.xyz) > 0.0) {
        if (sun_reaches < 0.0) sun_reaches = sun_visibility(at, facing);
        sum = light.irradiance.rgb * sun_reaches
            * reflected(n, v, light.to_sun.xyz, diffuse, f0, roughness);
    }
    for (uint i = 0; i < light.punctual_count.x; i++) {
        vec3 l;
        vec3 irradiance = punctual_irradiance(light.punctual[i], at, l);
        if (irradiance != vec3(0.0)) sum += irradiance * reflected(n, v, l, diffuse, f0, roughness);
    }
    return sum;
}

// Linear radiance towards the eye; alpha is the base colour's.
vec4 shade(MaterialGpu m, Surface s, vec3 world_eye, inout float sun_reaches) {
    vec4 base = base_color(m, s);
    vec4 rough_metal = fetch(m, METALLIC_ROUGHNESS_SLOT, m.metallic_roughness_texture, s, vec4(1.0));
    float roughness = clamp(m.roughness * rough_metal.g, 0.04, 1.0);
    float metallic = clamp(m.emissive_metallic.w * rough_metal.b, 0.0, 1.0);
    float occlusion = mix(1.0, fetch(m, OCCLUSION_SLOT, m.occlusion_texture, s, vec4(1.0)).r, m.occlusion_strength);
    vec3 n = mapped_normal(m, s), v = normalize(world_eye - s.world_position);
    vec3 f0 = mix(vec3(0.04), base.rgb, metallic), diffuse = base.rgb * (1.0 - metallic);
    vec3 zenith = light.zenith.rgb, horizon = light.horizon.rgb, nadir = light.nadir.rgb;
    vec3 ambient = sky_irradiance(zenith, horizon, nadir, n.y);
    vec3 mirrored = sky_reflection(zenith, horizon, nadir, reflect(-v, n).y, roughness);
    vec3 glow = fetch(m, EMISSIVE_SLOT, m.emissive_texture, s, vec4(1.0)).rgb;
    vec3 emissive = m.emissive_metallic.rgb * glow;
    float n_v = max(dot(n, v), 1e-3);
    vec3 direct =
        direct_light(s.world_position, normalize(s.world_normal), n, v, diffuse, f0, roughness, sun_reaches);
    vec3 radiance = direct
        + occlusion * (diffuse * ambient + mirrored * ambient_brdf(f0, roughness, n_v)) + emissive;
    return vec4(radiance, base.a);
}

// Linear display light, 0..1; alpha is the base colour's. What is unlit is shown as it is, not tone-mapped. sun_reaches: as
// direct_light has it.
vec4 display_color(MaterialGpu m, Surface s, vec3 world_eye, inout float sun_reaches) {
    if (m.unlit != 0) return clamp(base_color(m, s), 0.0, 1.0);
    vec4 shaded = shade(m, s, world_eye, sun_reaches);
    return vec4(tone_map(shaded.rgb), shaded.a);
}

#endif
