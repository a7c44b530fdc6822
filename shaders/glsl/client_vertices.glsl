// The client's vertex memory. A sample is three floats as bits and its tag; sample g of a vertex lies at
// [g mod SAMPLE_RING][slot]. A tag is the grid index with its highest bit turned, so that tags order like indices and
// 0 is no sample. positions: xyz in the world and a state. blends: what is left to blend away, as an offset and its
// share; STATIC_BLEND as share marks a static vertex. Tags and states: constants.rs.
#ifndef CLIENT_VERTICES_GLSL
#define CLIENT_VERTICES_GLSL

uint ring_place(uint slot, uint tag, uint vertex_slots) { return (tag % SAMPLE_RING) * vertex_slots + slot; }

#endif
