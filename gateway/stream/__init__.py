"""One TCP session of one source: connect, handshake, frames, silence, reconnect, clock, rate control."""
