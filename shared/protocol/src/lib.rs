//! Wire format, limits, time, atlas addressing, vertex codec and session of Shadecast, without I/O.
