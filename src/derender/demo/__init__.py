"""The whole story on built-in data: generate faces, train, score unseen ones beside controls, write one page.

story runs it, shows edited photographs before anything is trained, and gives the measured values; page turns
them into a report
"""

from derender.demo.page import demo_page
from derender.demo.story import FULL, QUICK, DemoResult, DemoSettings, Report, run_demo, run_own_demo

__all__ = ["FULL", "QUICK", "DemoResult", "DemoSettings", "Report", "demo_page", "run_demo", "run_own_demo"]
