//! An OpenXR runtime library for tests: scripted head, virtual clock, captures.
