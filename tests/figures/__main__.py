"""``make figures``: measure what is not kept yet, then print it into the documents' tables."""

import argparse
import sys

from figures import (  # noqa: F401  (each registers its jobs)
    commands,
    data,
    environments,
    forces,
    gpu,
    labels,
    load_cell,
    mechanics,
    pictures,
    pins,
    poses,
    recordings,
    robustness,
    safety,
    servo,
    studio,
    sure,
)
from figures.jobs import FIGURES, JOBS, FiguresError, Job, is_kept, lacking, run, values
from figures.same import keep_same
from figures.tables import documents, fill_documents, named_in_templates, used_in


def chosen(only: str) -> list[Job]:
    """Jobs of the named families, or of those names; all without any. Short ones first."""
    wanted = [name for name in only.split(",") if name]
    found = [job for job in JOBS.values() if not wanted or job.family in wanted or job.name in wanted]
    unknown = [name for name in wanted if not any(name in (job.family, job.name) for job in found)]
    if unknown:
        families = ", ".join(sorted({job.family for job in JOBS.values()}))
        raise FiguresError(f"no job or family is called {', '.join(unknown)}; families: {families}; jobs: {', '.join(sorted(JOBS))}")
    return sorted(found, key=lambda job: job.minutes)


def show(jobs: list[Job]) -> None:
    """A line for each job, then what documents and tables name that is not there."""
    for job in jobs:
        state = "kept" if is_kept(job) else "to be measured"
        if needed := lacking(job):
            state += f", needs {needed}"
        print(f"{job.name:34s} about {job.minutes:5g} min  {state}")
    named = named_in_templates() | {name for path in documents() for name in used_in(path.read_text())}
    absent = named - set(values())
    of = sorted({max((job for job in JOBS if name.startswith(f"{job}.")), key=len, default=name) for name in absent})
    print(f"{len(absent)} of {len(named)} figures that documents and tables name are missing" + (f", of {', '.join(of)}" if of else ""))


def main() -> None:
    """Measure, list, or fill tables."""
    parser = argparse.ArgumentParser(prog="make figures", description=__doc__)
    parser.add_argument("--only", default="", metavar="NAMES", help="families or jobs, with commas between")
    parser.add_argument("--list", action="store_true", help="what there is, what is kept, what is missing")
    parser.add_argument("--tables", action="store_true", help="only print the kept figures into the documents")
    parser.add_argument("--again", action="store_true", help="also what is kept")
    parser.add_argument("--same-as", metavar="COMMIT", help="keep figures that were kept there, of families whose samples are equal")
    options = parser.parse_args()
    try:
        jobs, failed = chosen(options.only), []
    except FiguresError as error:
        sys.exit(f"figures: {error}")
    if options.list:
        show(jobs)
        return
    if options.same_as:
        print(f"kept: {', '.join(keep_same(options.same_as)) or 'none'}")
        return
    for job in [] if options.tables else jobs:
        if is_kept(job) and not options.again:
            print(f"{job.name}: kept")
            continue
        if needed := lacking(job):
            print(f"{job.name}: left out, it needs {needed}")
            continue
        print(f"{job.name}: about {job.minutes:g} min", flush=True)
        try:
            for name, value in run(job).items():
                print(f"  {name} {value.value:.6g} {value.unit}".rstrip(), flush=True)
        except Exception as error:  # one job's failure is told, and the others go on
            failed.append(job.name)
            print(f"  FAILED: {error}", flush=True)
    for path in fill_documents():
        print(f"wrote tables into {path}")
    print(f"wrote {FIGURES}" if not options.tables else "")
    if failed:
        sys.exit(f"figures: {', '.join(failed)} failed")


if __name__ == "__main__":
    main()
