"""Trained models and how they travel: those that come with derender, cards, the Hugging Face Hub.

Each folder beside this file is one model with its card. Leaves out what models compute (``derender.model``).
"""
