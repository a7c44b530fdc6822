// All light of the scene at one time: sun, sky, and the lights of lamps. One buffer for the atlas, the ground truth and
// the shadow map.
#ifndef LIGHT_GLSL
#define LIGHT_GLSL

// A light as KHR_lights_punctual has it; one formula for its three kinds.
struct PunctualGpu {
    vec4 position_range;       // xyz world, metres; w 1 / range, 0 for none
    vec4 direction_kind;       // xyz unit, the way it shines; w 1: parallel, from everywhere
    vec4 intensity_cone_scale; // rgb; w 1 / (cos inner - cos outer), 0 where there is no cone
    vec4 cone_offset;          // x: -cos outer * scale, 1 where there is no cone
};

struct LightGpu {
    vec4 to_sun;          // xyz unit
    vec4 irradiance;      // rgb, on a surface that faces the sun
    vec4 zenith;          // rgb radiance
    vec4 horizon;
    vec4 nadir;
    mat4 shadow_from_world; // xy 0..1 over the map, z 1 nearest to the sun and 0 farthest
    vec4 shadow;          // x texels of a side, y a texel's width in metres, z 1: the sun casts shadows
    uvec4 punctual_count; // x
    PunctualGpu punctual[MAX_LIGHTS];
};

// Irradiance of a lamp on what faces it, and the unit vector towards it: attenuation by distance, range and cone as
// KHR_lights_punctual gives it. Nothing is nearer to a lamp than a centimetre.
vec3 punctual_irradiance(PunctualGpu lamp, vec3 at, out vec3 l) {
    vec3 shines = lamp.direction_kind.xyz;
    if (lamp.direction_kind.w != 0.0) {
        l = -shines;
        return lamp.intensity_cone_scale.rgb;
    }
    vec3 to_lamp = lamp.position_range.xyz - at;
    float square_m = max(dot(to_lamp, to_lamp), 1e-4);
    l = to_lamp * inversesqrt(square_m);
    float of_range = square_m * lamp.position_range.w * lamp.position_range.w;
    float fade = clamp(1.0 - of_range * of_range, 0.0, 1.0);
    float cone = clamp(dot(shines, -l) * lamp.intensity_cone_scale.w + lamp.cone_offset.x, 0.0, 1.0);
    return lamp.intensity_cone_scale.rgb * (fade * cone * cone / square_m);
}

#endif
