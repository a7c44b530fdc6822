//! The Android library around the Shadecast client.
