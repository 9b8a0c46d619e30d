"""The commands. No logic here: each one calls a function of the package and prints its result."""

from __future__ import annotations

import argparse
import json
import logging
import signal
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from posmas_fmi.errors import InputError, PosmasError

if TYPE_CHECKING:
    from posmas_fmi.cosim.master import Progress
    from posmas_fmi.design import Design
    from posmas_fmi.fmu.linearise import Linearisation

DONE, NEGATIVE, CANCELLED = 0, 1, 130
_SHOWN = 12  # agents in a list
_LARGEST_GAINS = 100_000_000  # bytes
_SCENARIO = "a file, or the name of a shipped scenario"


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Parameters
    ----------
    argv : sequence of str, optional
        Arguments; those of the process by default.

    Returns
    -------
    int
        0 done, 1 a verdict is negative, 2 bad input, 3 an FMU failed, 130 cancelled.
    """
    if argv is None:
        keep_interrupts()
    arguments = _parser().parse_args(argv)
    logging.basicConfig(level=logging.DEBUG if arguments.verbose else logging.WARNING)
    try:
        command: Callable[[argparse.Namespace], int] = arguments.command
        return command(arguments)
    except PosmasError as error:
        # what is found while a run begins, or runs, knows its place but not the file
        file = getattr(arguments, "scenario", "") if error.where.startswith("$") else ""
        print(f"posmas-fmi: {file}{file and ': '}{error}", file=sys.stderr)
        return error.exit_code
    except MemoryError as error:
        print(
            f"posmas-fmi: there is not enough memory ({error}); fewer agents, shorter delays, or "
            "fewer variables or communication points to record need less",
            file=sys.stderr,
        )
        return PosmasError.exit_code
    except KeyboardInterrupt:
        if argv is None:  # this process ends now, and another Ctrl-C adds nothing
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        print("posmas-fmi: cancelled", file=sys.stderr)
        return CANCELLED
    except BrokenPipeError:  # the reader of our output has gone, as with `| head`
        sys.stderr.close()
        return DONE


def keep_interrupts() -> None:
    """See that no Ctrl-C is lost, for a process that does one command.

    Python swallows an exception that comes up while it frees an object, with a traceback on
    stderr. If that exception is Ctrl-C, it is raised again where the program goes on: at its next
    line or call, whatever else it frees before.
    """

    def swallowed(it: Any) -> None:
        if not issubclass(it.exc_type, KeyboardInterrupt):
            sys.__unraisablehook__(it)
            return
        frame: FrameType | None = sys._getframe(1)
        while frame is not None:  # those that are there already
            frame.f_trace = again
            frame = frame.f_back
        sys.settrace(again)  # and those to come
        sys.setprofile(again)  # calls of functions in C as well: they may wait

    def again(frame: FrameType, event: str, argument: Any) -> None:
        if frame.f_code is not swallowed.__code__:  # what is raised there is swallowed as well
            sys.settrace(None)
            sys.setprofile(None)
            signal.raise_signal(signal.SIGINT)

    sys.unraisablehook = swallowed


# ---- the commands -------------------------------------------------------------------------------


def _run(arguments: argparse.Namespace) -> int:
    from posmas_fmi.fmu.prints import prints_to_stderr
    from posmas_fmi.scenario import load, run

    scenario = load(
        arguments.scenario,
        arguments.period,
        arguments.until,
        arguments.seed,
        arguments.outside,
    )
    if arguments.schedule:
        from posmas_fmi.scenario.main_job import scheduled

        schedule = scheduled(scenario)
        if arguments.json:
            _print_json(schedule.to_dict())
        else:
            print(schedule.to_text())
        return DONE
    folder = arguments.out or Path("out") / scenario.name
    branch = None
    if arguments.at is not None and arguments.branch is None:
        raise InputError("--at needs --branch DIR, the run whose snapshot that is")
    if arguments.branch is not None:
        if arguments.at is None:
            raise InputError("--branch needs --at S, the time of a snapshot of that run")
        if folder.resolve() == arguments.branch.resolve():
            raise InputError("a branch needs a folder of its own: give --out DIR", str(folder))
        branch = (arguments.branch, arguments.at)
    command = _command_line(arguments)
    with prints_to_stderr():
        result = run(
            scenario, folder, _progress, command=command, resume=arguments.resume, branch=branch
        )
    summary = result.summary
    if arguments.json:
        _print_json({**summary, "certified": result.certified, "folder": str(folder)})
    elif scenario.compare is not None:
        _show_comparison(summary)
        for page in _pages(folder, list(summary["comparison"])):
            print(f"report     {page}")
    else:
        print(f"verdict    {summary['verdict']}")
        if summary["reason"]:
            print(f"           {summary['reason']}")
        of_law = result.certified == result.design.certificate.certified
        other = "no (the certificate of the design is not about the law that ran)"
        print(f"certified  {_certified(result.design) if of_law else other}")
        uncovered = [one["what"] for one in summary["coverage"] if not one["covered"]]
        faults = (f for f in summary.get("faults", ()) if not f["covered"].startswith("covered"))
        uncovered += dict.fromkeys(fault["kind"] for fault in faults)
        if uncovered and result.certified != "no":
            print(f"           that does not cover {', '.join(uncovered)}")
        print(f"error      {_number(summary['tracking_error_final'])} to the leader at the end")
        print(f"min state  {_number(summary['min_state'])}")
        if summary.get("replay_noise") is not None:
            print(f"replay     steps done again differ by {_number(summary['replay_noise'])}")
        page = folder / "report.html"  # none where [record] leaves out what it is made of
        print(f"report     {page if page.is_file() else 'none'}")
    if summary["verdict"] == "failed":
        return 3
    if summary["verdict"] == "cancelled":
        return CANCELLED
    return DONE if result.good else NEGATIVE


def _design(arguments: argparse.Namespace) -> int:
    import attrs

    from posmas_fmi.scenario import load
    from posmas_fmi.scenario.job import make_design_of

    scenario = load(arguments.scenario, outside=arguments.outside)
    if arguments.method:
        settings = attrs.evolve(scenario.design, method=arguments.method)
        scenario = attrs.evolve(scenario, design=settings)
    return _show_design(make_design_of(scenario), arguments.json)


def _certify(arguments: argparse.Namespace) -> int:
    from posmas_fmi.design import certify
    from posmas_fmi.scenario import load
    from posmas_fmi.scenario.job import pinned_network

    scenario = load(arguments.scenario, outside=arguments.outside)
    K, E, K_q = _read_gains(arguments.gains)
    network, _ = pinned_network(scenario)
    made = certify(scenario.agent, network, K, E, scenario.design, scenario.clock.h, K_q)
    return _show_design(made, arguments.json)


def _paper(arguments: argparse.Namespace) -> int:
    from posmas_fmi.design.ledger import ledger, to_text

    entries = ledger()
    if arguments.json:
        _print_json({"entries": [entry.to_dict() for entry in entries]})
    else:
        print(to_text(entries))
    return DONE


def _report(arguments: argparse.Namespace) -> int:
    from posmas_fmi.report import write_report

    print(write_report(arguments.folder))
    return DONE


def _models(arguments: argparse.Namespace) -> int:
    from posmas_fmi.scenario.build import shipped_scenarios

    for path in shipped_scenarios():
        title = path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ")
        print(f"{path.stem:28}{title}")
    return DONE


def _fmu_build(arguments: argparse.Namespace) -> int:
    from posmas_fmi.fmu.build import build_plants

    if sys.stderr.isatty():
        print("building; the first build for another system takes minutes", file=sys.stderr)
    for path in build_plants(arguments.names, arguments.out):
        print(path)
    return DONE


def _export(arguments: argparse.Namespace) -> int:
    from posmas_fmi.scenario import load
    from posmas_fmi.scenario.export import export

    scenario = load(arguments.scenario, arguments.period, outside=arguments.outside)
    folder = arguments.out or Path("out") / f"{scenario.name}-export"
    made = export(scenario, folder, tuple(arguments.platform), arguments.controller)
    if arguments.json:
        _print_json(made.to_dict())
    else:
        for path in made.files:
            print(path)
        if made.no_ssp:
            print(f"no {'FMUs and no ' if made.no_fmu else ''}SSP file: {made.no_ssp}")
        of_law = made.certified == made.design.certificate.certified
        print(f"certified  {_certified(made.design) if of_law else made.certified}")
        covers = "covers" if made.delay["covered"] else "does not cover"
        if made.certified != "no":
            print(f"           that {covers} messages that take one period, as in other masters")
    return DONE if made.certified != "no" else NEGATIVE


def _regress(arguments: argparse.Namespace) -> int:
    import attrs

    from posmas_fmi.fmu.compare import regress
    from posmas_fmi.fmu.prints import prints_to_stderr

    with prints_to_stderr():
        result = regress(arguments.fmu, arguments.reference)
    rows = [attrs.asdict(deviation) for deviation in result.deviations]
    if arguments.json:
        _print_json({"passed": result.passed, "variables": rows})
    else:
        for row in rows:
            print("  ".join(f"{key} {_cell(value)}" for key, value in row.items()))
        print("passed" if result.passed else "FAILED: outside the band of the reference")
    return DONE if result.passed else NEGATIVE


def _linearise(arguments: argparse.Namespace) -> int:
    from posmas_fmi.fmu.linearise import linearise
    from posmas_fmi.fmu.prints import prints_to_stderr

    with prints_to_stderr():
        made = linearise(
            arguments.fmu,
            arguments.inputs,
            arguments.outputs,
            arguments.at,
            values=dict(arguments.set),
            states=arguments.states or None,
            step=arguments.step,
        )
    if arguments.json:
        _print_json(made.to_dict())
    else:
        _show_linearisation(made)
    return DONE if made.useful else NEGATIVE


def _fit(arguments: argparse.Namespace) -> int:
    from posmas_fmi.fmu.agent_toml import report
    from posmas_fmi.fmu.fit import fit_agent
    from posmas_fmi.fmu.prints import prints_to_stderr

    with prints_to_stderr():
        made = fit_agent(
            arguments.fmu,
            arguments.inputs,
            arguments.outputs,
            dict(arguments.region) or None,
            arguments.at,
            g=arguments.g or None,
            sec=arguments.sec or None,
            values=dict(arguments.set),
            states=arguments.states or None,
            degree=arguments.degree,
        )
    if arguments.json:
        _print_json(made.to_dict())
    else:
        print(f"{report(made)}\n{made.to_toml()}", end="")
    return DONE if made.useful else NEGATIVE


def _check(arguments: argparse.Namespace) -> int:
    from posmas_fmi.fmu.check.preflight import check_fmu
    from posmas_fmi.fmu.check.supervisor import Bounds, Supervisor
    from posmas_fmi.fmu.check.text import to_text

    made = []
    names = arguments.inputs, arguments.outputs
    with Supervisor(Bounds(call=arguments.deadline)) as supervisor:
        for path in arguments.fmus:
            made.append(
                check_fmu(
                    *(path, *names, dict(arguments.set)),
                    run=not arguments.static,
                    supervisor=supervisor,
                )
            )
            if not arguments.json:
                print(to_text(made[-1]), flush=True)
    if arguments.json:
        _print_json({"fmus": [one.to_dict() for one in made]})
    return max(one.exit_code for one in made)


# ---- output -------------------------------------------------------------------------------------


def _show_design(made: Design, as_json: bool) -> int:
    if as_json:
        _print_json(made.to_dict())
    else:
        certificate = made.certificate
        print(f"method        {made.method} ({made.observer} observer)")
        print(f"pinned        {', '.join(made.pinned)}")
        print(f"K             {made.K.tolist()}")
        print(f"E             {made.E.tolist()}")
        if made.K_q is not None:
            print(f"K_q           {made.K_q.tolist()} of {', '.join(made.integrates)}")
        print(f"certified     {_certified(made)}")
        print(f"rate          {_number(certificate.rate)} 1/s")
        print(f"observer      {_number(certificate.observer_rate)} 1/s")
        print(f"non-negative  {'proved' if certificate.positive else 'not proved'}")
        free = made.baseline
        word = "contracts" if free.contracts else "is not proved to contract"
        print(f"with K = 0    the agent {word} (rate {_number(free.rate)} 1/s)")
        _show_reach(made)
        for condition in certificate.conditions:
            mark = "holds" if condition.holds else "REFUTED" if condition.refuted else "not proved"
            print(f"  {mark:10}  {condition.name} (margin {_number(condition.margin)})")
            if not condition.holds:
                print(
                    f"              {'; '.join(filter(None, (condition.proof, condition.detail)))}"
                )
        for text in certificate.covers:
            print(f"  {'' if text.startswith('not covered') else 'covers: '}{text}")
        for note in made.notes:
            print(f"  note: {note}")
    return DONE if made.certificate.certified != "no" else NEGATIVE


def _show_reach(made: Design) -> None:
    """Region of attraction and guaranteed band, where they were asked for."""
    region, band = made.certificate.region_of_attraction, made.certificate.band
    if region is not None:
        start, error = _number(region.radius), _number(region.radius_estimation)
        print(f"saturation    attracted from |delta| <= {start} with exact estimates")
        print(f"              (estimation errors: share of {error}; {region.detail})")
    if band is not None:
        names = made.network.names
        worst = [f"{name}: {_number(max(row))}" for name, row in zip(names, band, strict=True)]
        more = f", … of {len(worst)} agents" if len(worst) > _SHOWN else ""
        print(f"deviation     at most {', '.join(worst[:_SHOWN])}{more}")


def _show_comparison(summary: dict[str, Any]) -> None:
    """Key figures by controller, then which limits each of them breaks."""
    found = summary["comparison"]
    if summary["verdict"] != "compared":
        print(f"verdict    {summary['verdict']} ({summary['reason']})")
    labels = {"tracking_error_final": "error to the leader at the end", "min_state": "min state"}
    if "kpi" in summary:
        labels = {
            k: f"{v['label']} [{v['unit']}]".removesuffix(" []") for k, v in summary["kpi"].items()
        }
    width = max(map(len, labels.values()))
    print(" " * width + "".join(f"  {name:>12}" for name in found))
    for key, label in labels.items():
        cells = (_number(figures.get(key)) for figures in found.values())
        print(f"{label:{width}}" + "".join(f"  {cell:>12}" for cell in cells))
    for name, figures in found.items():
        if "limits" not in figures:
            print(f"{name}: {figures['verdict']}")
            continue
        broken = [limit for limit, kept in figures.get("limits", {}).items() if kept is False]
        print(f"{name}: {'breaks ' + ', '.join(broken) if broken else 'keeps every limit'}")


def _pages(folder: Path, controllers: list[str]) -> list[Path]:
    """Return the report of a comparison, or where it has none those of its controllers."""
    page = folder / "report.html"
    of_each = [folder / name / "report.html" for name in controllers]
    return [page] if page.is_file() else [one for one in of_each if one.is_file()]


def _show_linearisation(made: Linearisation) -> None:
    print(f"interface  {made.interface}")
    print(f"method     {made.method}")
    if made.step is not None:
        print(f"step       {made.step:g} s")
    print(f"error      {_number(made.error)} at most in an entry, noise {made.noise:.2g}")
    print(f"at         {made.at:g} s")
    for label, names, values in (
        ("state", made.states, made.x0),
        ("input", made.inputs, made.u0),
        ("output", made.outputs, made.y0),
    ):
        for name, value in zip(names, values, strict=True):
            print(f"{label:11}{name} = {value:.6g}")
    print(f"time       {f'discrete, dt = {made.dt:g} s' if made.dt else 'continuous'}")
    for name in "ABCD":
        for k, row in enumerate(getattr(made, name)):
            print(f"{'' if k else name:11}[{', '.join(f'{value:.6g}' for value in row)}]")
    poles = ", ".join(f"{z.real:.6g}{f'{z.imag:+.6g}j' if z.imag else ''}" for z in made.poles)
    print(f"poles      {poles or 'none'} ({'stable' if made.stable else 'not stable'})")
    if made.named and not made.dt:
        report = made.metzler
        low = "; ".join(f"A[{i},{j}] = {v:.4g}" for i, j, v in report.negative)
        low_B = "; ".join(f"B[{i},{j}] = {v:.4g}" for i, j, v in report.negative_B)
        print(f"Metzler    {'yes' if report.metzler else f'no: {low}'}")
        print(f"B >= 0     {'yes' if not low_B else f'no: {low_B}'}")
    for note in made.notes:
        print(f"note       {note}")
    if not made.useful:
        print(f"verdict    of no use: the error is {made.uncertainty:.0%} of the largest entry")


def _certified(made: Design) -> str:
    certificate = made.certificate
    if certificate.certified == "conditional":
        words = (f"{a.name} {a.status}: {a.detail}" for a in certificate.open_assumptions)
        return f"conditional ({'; '.join(words)})"
    if certificate.certified == "no":
        parts = []
        for word, way in (("refuted", True), ("neither proved nor refuted", False)):
            names = [c.name for c in certificate.failing if c.refuted is way]
            if names:
                parts.append(f"{word}: {', '.join(names)}")
        return f"no ({'; '.join(parts)})"
    return certificate.certified


def _cell(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def _print_json(content: dict[str, Any]) -> None:
    print(json.dumps(content, indent=2, allow_nan=False))


def _command_line(arguments: argparse.Namespace) -> str:
    parts = ["posmas-fmi", "run", arguments.scenario]
    for name in ("until", "period", "seed"):
        value = getattr(arguments, name)
        if value is not None:
            parts += [f"--{name}", f"{value:g}"]
    return " ".join(parts)


def _progress(label: str) -> Progress | None:
    """Progress on stderr, on a terminal only: per cent and time left, twice a second."""
    if not sys.stderr.isatty():
        return None
    began = time.monotonic()
    shown = began

    def progress(done: int, total: int) -> None:
        nonlocal shown
        now = time.monotonic()
        if now - shown < 0.5 and done < total:
            return
        shown = now
        left = (now - began) / done * (total - done)
        end = "\n" if done == total else ""
        print(f"\r{label} {done / total:4.0%}, {left:.0f} s left  ", end=end, file=sys.stderr)
        sys.stderr.flush()

    return progress


# ---- input --------------------------------------------------------------------------------------


def _read_gains(path: Path) -> tuple[Any, Any, Any]:
    """Read K, E and K_q, where there is one, from a JSON file, also from a design.json."""
    from posmas_fmi.bounded import read_bounded

    try:
        content = json.loads(read_bounded(path, _LARGEST_GAINS))
    except (OSError, ValueError) as error:
        raise InputError(
            f'expected a JSON file like {{"K": [[..]], "E": [[..]]}} ({error})', str(path)
        ) from None
    missing = [k for k in ("K", "E") if not isinstance(content, dict) or k not in content]
    if missing:
        raise InputError(f"the key {missing[0]} is missing", str(path))
    return content["K"], content["E"], content.get("K_q")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="posmas-fmi",
        description="Design, prove and co-simulate pinning consensus of positive networks.",
    )
    parser.add_argument("--verbose", action="store_true", help="log what happens to stderr")
    parser.add_argument("--version", action=_Version, help="print the version and end")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, function: Callable[[argparse.Namespace], int], text: str) -> Any:
        command = commands.add_parser(name, help=text, description=text)
        command.set_defaults(command=function)
        return command

    run = add("run", _run, "design, certify, co-simulate, report")
    run.add_argument("scenario", help=_SCENARIO)
    outside = "the scenario may name files outside its folder"
    run.add_argument("--outside", action="store_true", help=outside)
    run.add_argument("--out", type=Path, metavar="DIR", help="output folder (default out/<name>)")
    run.add_argument("--until", type=_positive, metavar="S", help="end of the run [s]")
    run.add_argument("--period", type=_positive, metavar="S", help="control period [s]")
    run.add_argument("--seed", type=int, metavar="N", help="of every random number")
    run.add_argument("--json", action="store_true", help="print the summary as JSON")
    begin = run.add_mutually_exclusive_group()
    begin.add_argument(
        "--resume", action="store_true", help="go on with the run in the folder, which ended early"
    )
    begin.add_argument(
        "--branch", type=Path, metavar="DIR", help="go on from a snapshot of the run in DIR"
    )
    run.add_argument("--at", type=_seconds, metavar="S", help="time of that snapshot [s]")
    run.add_argument(
        "--schedule", action="store_true", help="print what a communication step does; do not run"
    )

    design = add("design", _design, "find gains and prove what they do")
    design.add_argument("scenario", help=_SCENARIO)
    design.add_argument("--outside", action="store_true", help=outside)
    design.add_argument(
        "--method",
        choices=("contraction", "lmi", "integral", "paper-1", "paper-2"),
        help="in place of the scenario's",
    )
    design.add_argument("--json", action="store_true", help="print gains and certificate as JSON")

    certify = add("certify", _certify, "certificate for given gains")
    certify.add_argument("scenario", help=_SCENARIO)
    certify.add_argument("--outside", action="store_true", help=outside)
    certify.add_argument(
        "--gains",
        type=Path,
        required=True,
        metavar="FILE.json",
        help='K and E, like {"K": [[..]], "E": [[..]]}; a design.json will do',
    )
    certify.add_argument("--json", action="store_true", help="print the certificate as JSON")

    report = add("report", _report, "write the report again from stored results")
    report.add_argument("folder", type=Path, metavar="DIR", help="output folder of a run")

    add("models", _models, "list the shipped scenarios")

    fmu = add("fmu", _fmu_build, "build the shipped FMUs")
    actions = fmu.add_subparsers(required=True, metavar="ACTION")
    text = "(re)build the shipped FMUs"
    build = actions.add_parser("build", help=text, description=text)
    build.add_argument("names", nargs="*", metavar="NAME", help="default: all")
    build.add_argument(
        "--out", type=Path, metavar="DIR", default=Path("fmus"), help="folder (default fmus)"
    )

    export = add("export", _export, "controllers as FMUs and C, with the plants as SSP")
    export.add_argument("scenario", help=_SCENARIO)
    export.add_argument(
        "--out", type=Path, metavar="DIR", help="output folder (default out/<name>-export)"
    )
    export.add_argument("--period", type=_positive, metavar="S", help="control period [s]")
    export.add_argument("--controller", metavar="NAME", help="which one of a comparison")
    export.add_argument(
        "--platform",
        action="append",
        default=[],
        metavar="NAME",
        help="system that the FMUs are for, as often as needed; default this one",
    )
    export.add_argument("--outside", action="store_true", help=outside)
    export.add_argument("--json", action="store_true", help="print what was written as JSON")

    regress = add("regress", _regress, "compare an FMU with a reference result")
    regress.add_argument("fmu", type=Path, metavar="FMU", help="the FMU to run")
    regress.add_argument(
        "reference", type=Path, metavar="REFERENCE.csv", help="time and the outputs to compare"
    )
    regress.add_argument("--json", action="store_true", help="print the deviations as JSON")

    paper = add("paper", _paper, "the ledger: printed, computed, verdict, proof")
    paper.add_argument("--json", action="store_true", help="print the entries as JSON")

    text = "linear model of an FMU at an operating point; exit code 1 if its error is too large"
    linear = add("linearise", _linearise, text)
    _add_operating_point(linear)
    linear.add_argument("--step", type=_positive, metavar="S", help="communication step [s]")
    linear.add_argument("--json", action="store_true", help="print the model as JSON")

    fit = add("fit", _fit, "fit model (1) to an FMU and print it as sections of a scenario")
    _add_operating_point(fit)
    for option, kind, metavar, text in (
        (
            "--region",
            _region,
            "NAME=LOW:HIGH",
            "deviations from the operating point: x, u for all states and inputs, x1, u1, ... for "
            "single ones; t in seconds (default: a tenth of each variable's size either side)",
        ),
        ("--g", str, "EXPR", "candidates for g in t, x1, ... (default: a polynomial)"),
        ("--sec", str, "EXPR", "sec of each input in u1, ... (default: a polynomial)"),
    ):
        fit.add_argument(
            option,
            type=kind,
            nargs="+",
            action="extend",
            default=[],
            metavar=metavar,
            help=text,
        )
    fit.add_argument(
        "--degree", type=int, choices=(1, 2, 3, 4, 5), default=2, help="of the polynomial g"
    )
    fit.add_argument("--json", action="store_true", help="print the fit as JSON")

    check = add("check", _check, "preflight of any FMU: exit 0 fine, 1 errors, 3 not usable")
    check.add_argument("fmus", type=Path, nargs="+", metavar="FMU", help="of FMI 1, 2 or 3")
    for option, dest, text in (
        ("--in", "inputs", "inputs that the controller will set"),
        ("--out", "outputs", "outputs that it will read: any real variables"),
    ):
        check.add_argument(
            option, dest=dest, nargs="+", action="extend", default=[], metavar="NAME", help=text
        )
    check.add_argument(
        "--set",
        type=_assignment,
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help="parameters, start values and inputs",
    )
    check.add_argument("--static", action="store_true", help="examine it only, run nothing of it")
    check.add_argument(
        "--deadline", type=_positive, default=10.0, metavar="S", help="of one call [s], default 10"
    )
    check.add_argument("--json", action="store_true", help="print everything as JSON")
    return parser


def _add_operating_point(command: Any) -> None:
    """Add what says which signals of which FMU, where."""
    command.add_argument("fmu", type=Path, metavar="FMU", help="of Model Exchange or Co-Simulation")
    for option, dest, required, text in (
        ("--in", "inputs", True, "inputs"),
        ("--out", "outputs", True, "outputs: any real variables"),
        ("--states", "states", False, "states, of an FMU that does not declare any"),
    ):
        command.add_argument(
            option,
            dest=dest,
            nargs="+",
            action="extend",
            metavar="NAME",
            required=required,
            help=text,
        )
    command.add_argument("--at", type=_seconds, default=0.0, metavar="T", help="time [s]")
    command.add_argument(
        "--set",
        type=_assignment,
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME=VALUE",
        help="parameters, start values and inputs",
    )


class _Version(argparse.Action):
    def __init__(self, option_strings: Sequence[str], dest: str, help: str) -> None:  # noqa: A002
        super().__init__(option_strings, dest, nargs=0, help=help)

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        parser.exit(message=f"posmas-fmi {version('posmas-fmi')}\n")


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number of seconds > 0 (got {text!r})")
    return value


def _seconds(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = float("nan")
    if not abs(value) < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a finite time in seconds (got {text!r})")
    return value


def _assignment(text: str) -> tuple[str, float]:
    name, _, number = text.rpartition("=")
    try:
        value = float(number)
    except ValueError:
        value = float("nan")
    if not name or not abs(value) < float("inf"):
        raise argparse.ArgumentTypeError(f"expected NAME=NUMBER (got {text!r})")
    return name, value


def _region(text: str) -> tuple[str, tuple[float, float]]:
    name, _, ends = text.partition("=")
    low, _, high = ends.partition(":")
    try:
        return name, (float(low), float(high))
    except ValueError:
        raise argparse.ArgumentTypeError(f"expected NAME=LOW:HIGH (got {text!r})") from None
