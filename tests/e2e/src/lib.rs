//! Whole-system tests: processes, sockets, codec, GPU stages against their CPU twins.
