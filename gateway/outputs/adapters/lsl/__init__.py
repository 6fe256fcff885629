"""The output for Lab Streaming Layer (LSL): one stream per source and component."""
