"""What a running gateway shows: metrics, health, HTTP pages, a status line."""
