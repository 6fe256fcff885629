"""The doctor: checks every layer between servers and subscribers, and suggests remedies."""
