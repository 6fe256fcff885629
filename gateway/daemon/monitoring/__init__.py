"""Monitoring of a running gateway: metrics, health, HTTP pages and the status line."""
