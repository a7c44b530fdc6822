//! Server, link and client on one virtual clock; metrics and reports.
