// The client's vertex memory. A sample is three floats as bits and its tag; sample g of a vertex lies at
// [g mod sample_ring][slot], sample_ring being a power of two. A tag is the grid index with its highest bit turned, so that tags order like indices and
// 0 is no sample. positions: xyz in the world and a state. blends: what is left to blend away, as an offset and its
// share; STATIC_BLEND as share marks a vertex without samples, PREDICTED_BLEND one whose samples are an update's predictions:
// these lie at [1 to PREDICTIONS][slot], and the tag is their time, in units of TIME_TAG_UNIT. skins: of a skinned vertex the number of its rest, which
// vertices of other instances may share, plus 1, and where its instance's palette and morph weights begin; NO_REST of
// others. Tags and states: constants.rs.
#ifndef CLIENT_VERTICES_GLSL
#define CLIENT_VERTICES_GLSL

uint ring_place(uint slot, uint tag, uint sample_ring, uint vertex_slots) {
    return (tag & (sample_ring - 1)) * vertex_slots + slot;
}

// What a skinned vertex is before its skeleton moves it.
struct RestGpu {
    uvec4 position_joints; // xyz bits of metres in the mesh's space, w the first two joints, 16 bits each
    uvec4 influences;      // x the other two joints, y and z weights of 16 bits, 65535 for 1, w its morph deltas: the first
                           // arena word, MORPH_FIRST_BITS of them, and above these how many
};

#endif
