"""What ``rtc3d-gateway top`` shows: tables of what gateways publish now."""
