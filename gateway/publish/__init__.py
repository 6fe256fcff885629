"""From one source to all outputs.

- ``fan_out``: numbers the messages of each component, keeps them in the history, and hands them to routes.
- ``routes``: the way to one output: its publishers, its pace, its counters and failures.
- ``tool_poses``: a topic for each tool, for outputs that want poses in metres.
- ``status_messages``: what the gateway says about a source once a second.
"""
