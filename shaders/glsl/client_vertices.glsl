// The client's vertex memory. A sample is three floats as bits and its tag; sample g of a vertex lies at
// [g mod SAMPLE_RING][slot]. A tag is the grid index with its highest bit turned, so that tags order like indices and
// 0 is no sample. positions: xyz in the world and a state. blends: what is left to blend away, as an offset and its
// share; a negative share marks a static vertex.
#ifndef CLIENT_VERTICES_GLSL
#define CLIENT_VERTICES_GLSL

const uint NO_SAMPLE = 0;
const float NOT_DRAWABLE = 0.0;
const float ON_CURVE = 1.0;
const float PAST_THE_END = 2.0; // or the future has changed: the next curve is blended to

#endif
