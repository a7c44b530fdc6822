//! QUIC on mio, server identity and the simulated link.
