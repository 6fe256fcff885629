"""The output for Foxglove, Lichtblick and PlotJuggler: a WebSocket server with the gateway's frames."""
