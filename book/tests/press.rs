//! Keeps the three outputs of a chapter consistent: notebooks up to date, cells formatted, formulas readable; and checks the checks.

use std::path::{Path, PathBuf};

use handful::study::statistics::{falls_below_again, ratio_t_interval, steps_to};
use handful::study::tables::Tables;
use handful_book::chapter::{Chapter, Part};
use handful_book::page::Page;
use handful_book::{format, notebook};
use pulldown_cmark::{Event, Options, Tag, TagEnd, TextMergeStream};
use serde_json::json;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn chapters() -> Vec<Chapter> {
    Chapter::all(&root().join("chapters")).expect("chapters that can be read")
}

#[test]
fn every_notebook_belongs_to_its_chapter() {
    let complaints: Vec<String> =
        chapters().iter().filter_map(|chapter| notebook::complaint(chapter, &root().join("notebooks"))).collect();
    assert!(complaints.is_empty(), "\n{}\n", complaints.join("\n"));
}

#[test]
fn every_cell_is_formatted() {
    for chapter in chapters() {
        let lines = format::unformatted(&chapter).expect("rustfmt");
        assert!(lines.is_empty(), "chapters/{}.md, cells at lines {lines:?}: run `cargo book format`", chapter.name);
    }
}

#[test]
fn every_formula_can_be_read() {
    for chapter in chapters() {
        if let Err(error) = Page::new(&chapter, &[]) {
            panic!("chapters/{}.md: {error}", chapter.name);
        }
    }
}

/// What is malformed stays as text on the page: a tag of a formula, or an alert with text behind its `[!NOTE]`.
#[test]
fn every_tag_and_every_alert_is_one_to_markdown() {
    for chapter in chapters() {
        let page = Page::new(&chapter, &[]).expect("a page").content;
        let events =
            TextMergeStream::new(pulldown_cmark::Parser::new_ext(&page, Options::ENABLE_GFM | Options::ENABLE_TABLES));
        let mut in_code = false;
        for event in events {
            match event {
                Event::Start(Tag::CodeBlock(_)) => in_code = true,
                Event::End(TagEnd::CodeBlock) => in_code = false,
                Event::Text(text) if !in_code => {
                    let malformed = text.contains("=\"") || text.contains("</") || text.contains("[!");
                    assert!(!malformed, "chapters/{}.md: `{text}` is neither a tag nor an alert", chapter.name);
                }
                _ => {}
            }
        }
    }
}

#[test]
fn every_chapter_is_in_the_summary_and_nothing_else_is() {
    let summary = std::fs::read_to_string(root().join("chapters/SUMMARY.md")).expect("a summary");
    for chapter in chapters() {
        assert!(summary.contains(&format!("({}.md)", chapter.name)), "{} is not in SUMMARY.md", chapter.name);
    }
    let notes = summary.matches("(notes/").count();
    assert_eq!(summary.matches(".md)").count(), chapters().len() + notes);
}

/// What the look-up page calls functions and types of the library is there.
#[test]
fn the_index_names_what_there_is() {
    let page = std::fs::read_to_string(root().join("chapters/notes/lookup.md")).expect("a page");
    let mut sources = String::new();
    let mut folders = vec![root().join("src")];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).expect("a folder") {
            let path = entry.expect("an entry").path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|kind| kind == "rs") {
                sources += &std::fs::read_to_string(path).expect("a source file");
            }
        }
    }
    let quoted = page.split('`').skip(1).step_by(2).filter(|text| text.contains("::"));
    let names: Vec<&str> = quoted.flat_map(|path| path.split("::")).collect();
    assert!(names.len() > 40);
    for name in names {
        let defined = ["fn", "struct", "enum", "mod"].map(|kind| format!("pub {kind} {name}"));
        assert!(defined.iter().any(|item| sources.contains(item.as_str())), "`{name}` is not in the library");
    }
}

/// A number in the summary of a study.
fn in_study(study: &str, task: &str, method: &str, column: &str) -> f64 {
    let table = table(study, "summary.csv");
    let place = table[0].iter().position(|name| name == column).expect("a column");
    let row = table.iter().find(|row| row[..2] == [task, method]).expect("a row");
    row[place].parse().unwrap_or(f64::NAN)
}

/// SAC's steps to 80 % over the method's, and its t interval, in the study of the task.
fn sac_steps_ratio(task: &str, method: &str) -> [f64; 3] {
    ["sac_steps_ratio", "sac_steps_ratio_t_low", "sac_steps_ratio_t_high"]
        .map(|column| in_study(task, task, method, column))
}

/// The number of successful test episodes of each seed.
fn test_successes(study: &str, task: &str, method: &str) -> Vec<usize> {
    let mut seeds = std::collections::BTreeMap::new();
    for row in rows(study, "tests.csv", task, method) {
        *seeds.entry(row[2].clone()).or_default() += usize::from(row[5] == "true");
    }
    seeds.into_values().collect()
}

/// The step by which each seed of a method is at 80 %, in the study of the task.
fn steps_to_80(task: &str, method: &str) -> Vec<f64> {
    curves(task, task, method).iter().map(step_of_80).collect()
}

/// The step by which a seed that is not censored is at 80 %.
fn step_of_80((steps, success): &(Vec<f64>, Vec<f64>)) -> f64 {
    steps_to(0.8, steps, success).expect("no seed is censored")
}

/// The learning curve of each seed of a method: steps and success rates.
fn curves(study: &str, task: &str, method: &str) -> Vec<(Vec<f64>, Vec<f64>)> {
    let tables = Tables::read(&root().join("data/study").join(study)).expect("tables");
    tables.curves(task, method).expect("curves")
}

/// What the five seeds of a method have, as a text lists it.
fn listed(of_seeds: &[impl ToString]) -> String {
    let texts: Vec<String> = of_seeds.iter().map(ToString::to_string).collect();
    format!("{} and {}", texts[..4].join(", "), texts[4])
}

/// The rows of a table of a study that are about a method on a task.
fn rows(study: &str, name: &str, task: &str, method: &str) -> Vec<Vec<String>> {
    table(study, name).into_iter().filter(|row| row[..2] == [task, method]).collect()
}

/// A table of a study, its header first.
fn table(study: &str, name: &str) -> Vec<Vec<String>> {
    let table = std::fs::read_to_string(root().join("data/study").join(study).join(name)).expect("a table");
    table.lines().map(|line| line.split(',').map(String::from).collect()).collect()
}

/// The open-loop error of a method's model in standard deviations of the change: the median of its seeds at the last step.
fn model_error(task: &str, method: &str, steps_ahead: &str) -> f64 {
    let rows = rows(task, "models.csv", task, method);
    let step = |row: &Vec<String>| row[3].parse::<usize>().expect("a step");
    let last = rows.iter().map(step).max().expect("a row");
    let errors = rows.iter().filter(|row| step(row) == last && row[4] == steps_ahead);
    let mut errors: Vec<f64> = errors.map(|row| row[5].parse().expect("an error")).collect();
    errors.sort_by(f64::total_cmp);
    assert_eq!(errors.len(), 5);
    errors[2]
}

/// README and chapters say what the tables of the studies say.
#[test]
fn numbers_from_studies_are_quoted_as_they_are() {
    let success = |study: &str, task: &str, method: &str| {
        let [rate, low, high] =
            ["success", "success_low", "success_high"].map(|column| 100.0 * in_study(study, task, method, column));
        format!("{rate:.0} % [{low:.0}, {high:.0}]")
    };
    let reach = |method: &str, column: &str| in_study("reach", "reach", method, column);
    let first = |method: &str, column: &str| in_study("first", "reach", method, column);
    let thousands = |steps: f64| match steps as usize {
        steps if steps < 1000 => steps.to_string(),
        steps => format!("{},{:03}", steps / 1000, steps % 1000),
    };
    let ratio = |task: &str, method: &str| {
        let [ratio, low, high] = sac_steps_ratio(task, method);
        match method {
            "sac" => "1".into(),
            _ if ratio.is_nan() => "-".into(),
            _ => format!("{ratio:.1} [{low:.1}, {high:.1}]"),
        }
    };
    let mut quotes: Vec<(&str, String)> = Vec::new();
    for (name, method) in [("random", "random"), ("scripted (by hand)", "scripted")] {
        let (success, sparc) = (success("reach", "reach", method), reach(method, "smoothness_sparc"));
        quotes.push(("README.md", format!("| {name} | {success} | - | - | - | {sparc:.2} |")));
    }
    for (task, columns, digits) in [("reach", "- | - | -", 2), ("lift", "- | -", 1), ("push", "- | - | -", 1)] {
        let (success, sparc) =
            (success("oracle", task, "oracle"), in_study("oracle", task, "oracle", "smoothness_sparc"));
        let row = format!("| oracle (plans on the true simulator) | {success} | {columns} | {sparc:.digits$} |");
        quotes.push(("README.md", row));
    }
    for (name, method, digits) in [
        ("PETS (knows the reward)", "pets", 1),
        ("TD-MPC2", "tdmpc2", 1),
        ("SAC", "sac", 3),
        ("PETS (learns the reward)", "pets-learned", 1),
        ("Dreamer", "dreamer", 2),
    ] {
        let [steps, ms, sparc] = ["steps_to_80", "action_ms", "smoothness_sparc"].map(|column| reach(method, column));
        let (success, steps, ratio) = (success("reach", "reach", method), thousands(steps), ratio("reach", method));
        quotes.push(("README.md", format!("| {name} | {success} | {steps} | {ratio} | {ms:.digits$} | {sparc:.2} |")));
        assert_eq!(reach(method, "seeds_reaching_80"), 5.0);
    }
    let lift = |method: &str, column: &str| in_study("lift", "lift", method, column);
    for (name, method) in [
        ("SAC", "sac"),
        ("TD-MPC2", "tdmpc2"),
        ("PETS (knows the reward)", "pets"),
        ("Dreamer", "dreamer"),
        ("PETS (learns the reward)", "pets-learned"),
    ] {
        let [steps, seeds, sparc] =
            ["steps_to_80", "seeds_reaching_80", "smoothness_sparc"].map(|column| lift(method, column));
        let steps = if steps.is_nan() { "-".into() } else { thousands(steps) };
        let (success, ratio) = (success("lift", "lift", method), ratio("lift", method));
        quotes.push(("README.md", format!("| {name} | {success} | {steps} ({seeds}) | {ratio} | {sparc:.1} |")));
    }
    for (study, task, plan) in [
        ("oracle", "reach", "4 actions, each held 2 steps | 2 x 20 | 42"),
        ("oracle", "push", "10 actions, each held 3 steps; the final reward counts 100 times | 4 x 64 | 810"),
        ("oracle", "lift", "8 knots of a spline, 3 steps apart; the final reward counts 5 times | 3 x 32 | 230"),
        ("oracle", "stack", "12 knots, 4 steps apart; the final reward counts 20 times | 3 x 40 | 800"),
        ("door", "door", "12 knots, 4 steps apart; the final reward counts 20 times | 3 x 40 | 770"),
    ] {
        let episodes = in_study(study, task, "oracle", "test_episodes");
        let successes = test_successes(study, task, "oracle")[0];
        quotes.push(("README.md", format!("| `{task}` | {plan} | {successes} of {episodes} |")));
    }
    let [pets, learned] = ["pets", "pets-learned"].map(|method| success("lift", "lift", method));
    let dreamer = ["success", "success_low", "success_high"].map(|column| 100.0 * lift("dreamer", column));
    let [dreamer, low, high] = dreamer.map(|rate| format!("{rate:.0}"));
    let dreamer = format!("in {dreamer} % of the test episodes (95 % interval from {low} to {high}");
    let by = |method: &str| thousands(lift(method, "steps_to_80"));
    let [times, low, high] = sac_steps_ratio("lift", "dreamer");
    let needs = format!("SAC needs {times:.1} times as many on average (t interval from {low:.1} to {high:.1})");
    let [_, low, high] = sac_steps_ratio("lift", "pets");
    let medians = format!(
        "The median seed of PETS is at 80 % by step {}, that of SAC (chapter 8) by {}, but five seeds do not show that PETS is earlier (SAC takes {low:.1} to {high:.1} times as many steps, t interval)",
        by("pets"),
        by("sac")
    );
    quotes.extend([
        ("README.md", format!("On `lift`, PETS succeeds in {pets} of the test episodes")),
        ("README.md", format!("it lifts in {learned} after 20,000")),
        ("chapters/06-pets.md", medians),
        ("chapters/10-dreamer.md", needs),
        ("chapters/10-dreamer.md", format!("Dreamer lifts {dreamer}")),
    ]);
    let steps: Vec<String> = steps_to_80("lift", "pets").into_iter().map(thousands).collect();
    let [rate, sparc] = ["success", "smoothness_sparc"].map(|column| lift("pets", column));
    quotes.extend(
        [
            format!("are at 80 % by step {}", listed(&steps)),
            format!("{:.0} % on average", 100.0 * rate),
            format!("(SPARC {sparc:.1} instead of -4.8)"),
        ]
        .map(|quote| ("chapters/14-case-study.md", quote)),
    );
    let reaching = ["pets", "sac", "tdmpc2", "dreamer", "pets-learned"].map(|method| lift(method, "seeds_reaching_80"));
    assert_eq!(reaching, [5.0; 5]);
    for (method, files) in [
        ("pets", ["README.md", "chapters/06-pets.md", "chapters/14-case-study.md"].as_slice()),
        ("pets-learned", &["README.md", "chapters/06-pets.md"]),
    ] {
        let of_seeds = format!("{} of 100", listed(&test_successes("lift", "lift", method)));
        quotes.extend(files.iter().map(|file| (*file, of_seeds.clone())));
    }
    assert_eq!(test_successes("lift", "lift", "pets-learned"), [84, 88, 89, 88, 90]);
    assert_eq!(test_successes("push", "push", "sac"), [88, 92, 73, 95, 92]);
    quotes.push(("README.md", "they succeed in 88, 92, 73, 95 and 92 of 100 test episodes".into()));
    let [sac, of_dreamer, tdmpc2, of_pets, learned] = ["sac", "dreamer", "tdmpc2", "pets", "pets-learned"]
        .map(|method| test_successes("lift", "lift", method).iter().sum::<usize>());
    let successes = format!(
        "SAC succeeds in {sac} of 500 test episodes after 20,000 steps (Dreamer in {of_dreamer}, TD-MPC2 in {tdmpc2}, PETS with the known reward in {of_pets}, PETS with a learned reward in {learned})"
    );
    quotes.push(("chapters/08-sac.md", successes));
    assert_eq!(test_successes("lift", "lift", "dreamer"), [100, 96, 100, 100, 99]);
    let [dreamer, tdmpc2, pets] = ["dreamer", "tdmpc2", "pets"]
        .map(|method| ["reach", "lift", "push"].map(|task| model_error(task, method, "15")));
    quotes.extend([
        (
            "README.md",
            format!(
                "are {:.1} and {:.1} standard deviations of the change on `reach`, on `lift` {:.1} and {:.1}, and on `push` {:.1} and {:.1}; one step ahead on `lift`, where little changes, Dreamer's is {:.0} (medians",
                dreamer[0],
                tdmpc2[0],
                dreamer[1],
                tdmpc2[1],
                dreamer[2],
                tdmpc2[2],
                model_error("lift", "dreamer", "1")
            ),
        ),
        ("README.md", format!("whose dynamics have no lasso, they are {:.2} and {:.1}", pets[0], pets[1])),
    ]);
    let push = |method: &str, column: &str| in_study("push", "push", method, column);
    for (name, method) in [
        ("PETS (knows the reward)", "pets"),
        ("PETS (learns the reward)", "pets-learned"),
        ("TD-MPC2", "tdmpc2"),
        ("Dreamer", "dreamer"),
        ("SAC", "sac"),
    ] {
        let [steps, by, seeds, reaching, sparc] =
            ["steps", "steps_to_80", "seeds", "seeds_reaching_80", "smoothness_sparc"]
                .map(|column| push(method, column));
        let (success, ratio) = (success("push", "push", method), ratio("push", method));
        let by = if by.is_nan() { "-".into() } else { thousands(by) };
        let steps = thousands(steps);
        quotes.push((
            "README.md",
            format!("| {name} | {success} | {steps} | {by} ({reaching} of {seeds}) | {ratio} | {sparc:.1} |"),
        ));
    }
    let [seeds, reaching] = ["seeds", "seeds_reaching_80"]
        .map(|column| ["pets", "pets-learned", "sac", "tdmpc2", "dreamer"].map(|method| push(method, column)));
    assert_eq!((seeds, reaching), ([5.0; 5], [5.0, 5.0, 5.0, 4.0, 5.0]));
    let of_seeds = listed(&test_successes("push", "push", "pets-learned"));
    quotes.extend([
        ("README.md", format!("it succeeds in {of_seeds} of 100 test episodes")),
        ("chapters/06-pets.md", format!("succeed in {of_seeds} of 100 test episodes after 20,000")),
    ]);
    let difference = |method: &str| {
        let [low, high] =
            ["success_minus_sac_t_low", "success_minus_sac_t_high"].map(|column| 100.0 * push(method, column));
        format!("{low:.0} to {high:.0} percentage points")
    };
    let [pets, learned, tdmpc2, dreamer] = ["pets", "pets-learned", "tdmpc2", "dreamer"].map(difference);
    let differences = format!(
        "from {pets} for PETS with the known reward, from {tdmpc2} for TD-MPC2, from {dreamer} for Dreamer, and from {learned} for PETS with a learned one"
    );
    quotes.push(("README.md", differences));
    let [times, low, high] = sac_steps_ratio("reach", "pets");
    let mean = |method: &str| reach(method, "steps_to_80_restricted_mean");
    let pets = format!("evaluation episodes after {:.0} environment steps, on average over five seeds", mean("pets"));
    let sac = format!(
        "needs {:.0} on average, {times:.1} times as many; with five runs each, this factor is uncertain (95 % interval from {low:.1} to {high:.1})",
        mean("sac")
    );
    let [times, low, high] = sac_steps_ratio("reach", "tdmpc2");
    let tdmpc2 = format!(
        "SAC takes {times:.1} times as many steps (`data/study/reach`; t interval from {low:.1} to {high:.1}, bootstrap"
    );
    let learned = format!(
        "With a learned reward, PETS succeeds in {} of the test episodes",
        success("reach", "reach", "pets-learned")
    );
    quotes.extend([
        ("chapters/00-start.md", pets),
        ("chapters/00-start.md", sac),
        ("chapters/11-tdmpc2.md", tdmpc2),
        ("README.md", learned),
    ]);
    let [_, low, high] = sac_steps_ratio("reach", "pets-learned");
    let interval = format!("t interval from {low:.1} to {high:.1}");
    assert!(mean("pets-learned") < mean("sac") && mean("sac") < mean("tdmpc2").min(mean("dreamer")));
    let successes = test_successes("reach", "reach", "pets-learned").iter().sum::<usize>();
    assert_eq!(successes, 500);
    // The curves, as their figure's alternative text tells them, and how many runs fall below 80 % again.
    let range = |method: &str| {
        let steps = steps_to_80("reach", method);
        let [first, last] = [steps.iter().copied().fold(f64::MAX, f64::min), steps.iter().copied().fold(0.0, f64::max)];
        format!("by {} to {}", thousands(first), thousands(last))
    };
    let [pets, learned, sac, tdmpc2, dreamer] = ["pets", "pets-learned", "sac", "tdmpc2", "dreamer"].map(range);
    let figure = format!(
        "PETS is at 80 % {pets}; PETS with a learned reward {learned}; SAC {sac}; TD-MPC2 {tdmpc2}; Dreamer {dreamer}]"
    );
    quotes.extend(["README.md", "chapters/00-start.md"].map(|file| (file, figure.clone())));
    let falling = |task: &str, methods: &[&str]| {
        let of_method = |method: &&str| {
            curves(task, task, method).iter().filter(|(steps, success)| falls_below_again(0.8, steps, success)).count()
        };
        methods.iter().map(of_method).collect::<Vec<usize>>()
    };
    assert_eq!(falling("reach", &["pets", "pets-learned", "sac", "tdmpc2", "dreamer"]), [0, 0, 0, 1, 3]);
    assert_eq!(falling("lift", &["pets", "pets-learned", "sac", "tdmpc2", "dreamer"]), [3, 2, 0, 0, 0]);
    assert_eq!(falling("push", &["pets", "pets-learned", "sac", "tdmpc2", "dreamer"]), [0, 1, 1, 2, 0]);
    quotes.extend(
        [
            ("chapters/12-study.md", "Four of the 25 runs (three of Dreamer, one of TD-MPC2)"),
            ("README.md", "Four of the ten seeds of TD-MPC2 and Dreamer fall below 80 % again"),
            (
                "README.md",
                "Three of its five seeds with the known reward, and two with a learned one, fall below 80 % again",
            ),
            (
                "README.md",
                "Two of its seeds, and one of SAC and one of PETS with a learned reward, fall below 80 % again",
            ),
        ]
        .map(|(file, quote)| (file, quote.into())),
    );
    // If all of SAC's times were 100 steps late.
    let earlier: Vec<f64> = steps_to_80("reach", "sac").iter().map(|step| step - 100.0).collect();
    let [known, learned] = ["pets", "pets-learned"].map(|method| {
        let steps = steps_to_80("reach", method);
        let [low, high] = ratio_t_interval(&earlier, &steps).expect("five seeds");
        let ratio = earlier.iter().sum::<f64>() / steps.iter().sum::<f64>();
        format!("{ratio:.1} [{low:.1}, {high:.1}]")
    });
    quotes.push(("README.md", format!("would be {known} with the known reward and {learned} with a learned one")));
    // If all had been evaluated every 500 steps only.
    let coarser = |method: &str| -> Vec<f64> {
        let at_500 = |(steps, success): &(Vec<f64>, Vec<f64>)| {
            step_of_80(&steps.iter().zip(success).filter(|(step, _)| **step % 500.0 == 0.0).unzip())
        };
        curves("reach", "reach", method).iter().map(at_500).collect()
    };
    let sac = coarser("sac");
    let [known, learned] = ["pets", "pets-learned"].map(|method| {
        let steps = coarser(method);
        let [low, high] = ratio_t_interval(&sac, &steps).expect("five seeds");
        format!("{:.1} [{low:.1}, {high:.1}]", sac.iter().sum::<f64>() / steps.iter().sum::<f64>())
    });
    quotes.push((
        "README.md",
        format!("Evaluated every 500 steps, as an earlier study was, they would be {known} and {learned}"),
    ));
    // Smoothness beside SAC's, and open-loop errors.
    let rougher = |task: &str, method: &str| {
        ["sparc_minus_sac", "sparc_minus_sac_t_low", "sparc_minus_sac_t_high"]
            .map(|column| in_study(task, task, method, column))
    };
    let shown = |task: &str| {
        let [difference, low, high] = rougher(task, "pets");
        format!("{difference:+.2} [{low:+.2}, {high:+.2}]")
    };
    quotes.push((
        "README.md",
        format!(
            "SPARC minus SAC's is {} on `reach` and {} on `push`, but {} on `lift`",
            shown("reach"),
            shown("push"),
            shown("lift")
        ),
    ));
    for task in ["reach", "lift", "push"] {
        assert!(["tdmpc2", "pets-learned"].iter().all(|method| rougher(task, method)[2] < 0.0), "{task}");
        assert!(["tdmpc2", "dreamer"].iter().all(|method| model_error(task, method, "15") > 1.2), "{task}");
        assert_eq!(test_successes("oracle", task, "oracle"), [100]);
    }
    assert_eq!([test_successes("oracle", "stack", "oracle"), test_successes("door", "door", "oracle")], [[100], [99]]);
    assert!(rougher("reach", "dreamer")[2] < 0.0);
    let [reach_error, lift_error, push_error] = ["reach", "lift", "push"].map(|task| model_error(task, "pets", "15"));
    quotes.push((
        "README.md",
        format!("are {reach_error:.2}, {lift_error:.2} and {push_error:.2} standard deviations of the change"),
    ));
    let [dreamer, sac] = ["dreamer", "sac"].map(|method| push(method, "smoothness_ldlj"));
    quotes.push(("README.md", format!("its log dimensionless jerk is worse ({dreamer:.1}, SAC {sac:.1})")));
    quotes.extend([
        ("chapters/00-start.md", format!("on this easy task ({:.0})", mean("pets-learned"))),
        ("chapters/06-pets.md", format!("this agent succeeds in all {successes} test episodes")),
        ("chapters/12-study.md", format!("it now needs fewer, too ({interval})")),
    ]);
    let steps: Vec<String> = steps_to_80("reach", "pets").into_iter().map(thousands).collect();
    let of_seeds = test_successes("reach", "reach", "pets");
    assert_eq!(of_seeds, [100, 100, 100, 99, 100]);
    let pets = format!("by step {}, and succeed in {} of 100 test episodes", listed(&steps), listed(&of_seeds));
    quotes.push(("chapters/06-pets.md", pets));
    let sac = 500.0 * first("sac", "success");
    let earlier = |study: &str, method: &str| {
        let [probability, low, high] = ["earlier_than_sac", "earlier_than_sac_low", "earlier_than_sac_high"]
            .map(|column| in_study(study, "reach", method, column));
        format!("with probability {probability:.2} [{low:.2}, {high:.2}]")
    };
    quotes.extend([
        ("chapters/12-study.md", format!("SAC succeeded in {sac:.0} of 500 episodes")),
        ("chapters/12-study.md", format!("a random seed of SAC {}", earlier("first", "tdmpc2"))),
        ("chapters/12-study.md", format!("earlier than one of SAC {}", earlier("reach", "pets-learned"))),
        ("chapters/12-study.md", format!("one of TD-MPC2 {}", earlier("reach", "tdmpc2"))),
        ("chapters/12-study.md", format!("one of Dreamer {}", earlier("reach", "dreamer"))),
    ]);
    let [sac, pets, learned, tdmpc2, dreamer] = ["sac", "pets", "pets-learned", "tdmpc2", "dreamer"]
        .map(|method| in_study("quick", "reach", method, "seconds_to_80"));
    for file in ["README.md", "chapters/12-study.md"] {
        let seconds = format!(
            "in the median after {sac:.0} s, PETS after {pets:.0} s (with a learned reward {learned:.0} s), TD-MPC2 after {tdmpc2:.0} s and Dreamer after {dreamer:.0} s"
        );
        quotes.push((file, seconds));
    }
    let [lift_pets, lift_dreamer] = ["pets", "dreamer"].map(|method| ratio("lift", method));
    let [reach_pets, reach_learned] = ["pets", "pets-learned"].map(|method| ratio("reach", method));
    let push_pets = ratio("push", "pets");
    quotes.extend([
        ("README.md", format!("needs fewer steps on `reach` ({reach_pets}) and `push` ({push_pets})")),
        ("README.md", format!("On `lift`, no difference is shown ({lift_pets})")),
        (
            "README.md",
            format!(
                "fewer steps than SAC on `reach` ({reach_learned}) and `push` ({}), and Dreamer on `lift` ({lift_dreamer})",
                ratio("push", "pets-learned")
            ),
        ),
    ]);
    // No other method is shown to differ from SAC.
    let others = [
        ("reach", "dreamer"),
        ("reach", "tdmpc2"),
        ("lift", "pets-learned"),
        ("lift", "tdmpc2"),
        ("lift", "pets"),
        ("push", "dreamer"),
    ];
    for (task, method) in others {
        let [_, low, high] = sac_steps_ratio(task, method);
        assert!(low < 1.0 && 1.0 < high, "{method} on {task}: {low} to {high}");
    }
    // Nor to succeed more often; PETS succeeds less often on `lift`, and with a learned reward on `push`.
    for task in ["reach", "lift", "push"] {
        for method in ["pets", "pets-learned", "tdmpc2", "dreamer"] {
            let end = |end: &str| in_study(task, task, method, &format!("success_minus_sac_t_{end}"));
            assert!(end("low") <= 0.0, "{method} on {task}");
            let less = [("lift", "pets"), ("lift", "pets-learned"), ("push", "pets-learned")].contains(&(task, method));
            assert_eq!(end("high") < 0.0, less, "{method} on {task}");
        }
    }
    assert!(sac_steps_ratio("push", "tdmpc2")[0].is_nan(), "one of its seeds is censored");
    for method in ["pets", "pets-learned"] {
        let [less, high, low] = ["success_minus_sac", "success_minus_sac_t_high", "success_minus_sac_t_low"]
            .map(|column| -100.0 * lift(method, column));
        let less = format!("{less:.0} percentage points less than SAC (t interval from {high:.0} to {low:.0})");
        quotes.push(("README.md", less));
    }
    let median = |method: &str| thousands(reach(method, "steps_to_80"));
    quotes.extend([
        (
            "chapters/10-dreamer.md",
            format!(
                "All five seeds of Dreamer reach a success rate of 80 % by step {}, the median seed by step {}",
                thousands(steps_to_80("reach", "dreamer").into_iter().fold(0.0, f64::max)),
                median("dreamer")
            ),
        ),
        (
            "chapters/08-sac.md",
            format!("The five seeds of SAC are at 80 % by step 500 to 1,000, the median by {}", median("sac")),
        ),
    ]);
    for (file, quote) in quotes {
        let text = std::fs::read_to_string(root().join(file)).expect("a page");
        let text = text.split_whitespace().collect::<Vec<&str>>().join(" ");
        assert!(text.contains(&quote), "{file} does not say what the tables say: {quote}");
    }
}

#[test]
fn a_chapter_is_taken_apart_and_its_program_keeps_the_lines() {
    let text = "# Title\n\n```rust\nlet x = 1; // one\n```\ntext\n\n```rust,ignore\nnot run\n```\n<details>\n\n```rust\nx\n```\n</details>\n";
    let chapter = Chapter::parse("t", text).expect("a chapter");
    let cells: Vec<(&str, usize, bool)> = chapter
        .parts
        .iter()
        .filter_map(|part| match part {
            Part::Cell { code, line, folded } => Some((code.as_str(), *line, *folded)),
            Part::Text(_) => None,
        })
        .collect();
    assert_eq!(cells, [("let x = 1; // one\n", 4, false), ("x\n", 14, true)]);
    let program = chapter.program();
    let lines: Vec<&str> = program.lines().collect();
    assert_eq!((lines[3], lines[4], lines[13], lines[14]), ("let x = 1; // one", ";", "x", ";"));
    assert!(!program.contains("not run"));
    let error = Chapter::parse("t", "```rust\nlet x = 1;\n").expect_err("a fence that is not closed");
    assert!(error.to_string().contains("chapters/t.md:1"), "{error}");
    let error = Chapter::parse("t", "let x = 1;\n```\n").expect_err("a cell without its opening fence");
    assert!(error.to_string().contains("chapters/t.md:2"), "{error}");
}

/// A planted change, a planted gap and a planted panic are each found.
#[test]
fn stale_and_failed_notebooks_are_found() {
    let folder = std::env::temp_dir().join(format!("handful-press-{}", std::process::id()));
    std::fs::create_dir_all(&folder).expect("a folder");
    let chapter = "# T\n> [!NOTE]\n> Two.\n\n```rust\nassert!(1 + 1 == 2);\n```\n";
    let chapter = Chapter::parse("t", chapter).expect("a chapter");
    assert_eq!(notebook::generate(&chapter)["cells"][1]["source"], json!(["# T\n", "> Two."]), "Jupyter has no alerts");
    let missing = notebook::complaint(&chapter, &folder).expect("there is no notebook");
    assert!(missing.contains("cargo book notebooks t"), "{missing}");

    let mut executed = notebook::generate(&chapter);
    for (i, cell) in executed["cells"].as_array_mut().expect("cells").iter_mut().enumerate() {
        if cell["cell_type"] == "code" {
            cell["execution_count"] = json!(i + 1);
        }
    }
    let path = folder.join("t.ipynb");
    notebook::write(&path, &executed).expect("written");
    assert_eq!(notebook::complaint(&chapter, &folder), None);

    let changed = Chapter::parse("t", "# T\n\n```rust\nassert!(1 + 1 == 3);\n```\n").expect("a chapter");
    assert!(notebook::complaint(&changed, &folder).expect("stale").contains("is older than"));
    notebook::write(&path, &notebook::generate(&chapter)).expect("written");
    assert!(notebook::complaint(&chapter, &folder).expect("not executed").contains("not executed"));

    assert_eq!(notebook::failure(&executed), None);
    let panic =
        json!([{ "output_type": "stream", "name": "stderr", "text": ["thread panicked at src/lib.rs:2:1:\n"] }]);
    executed["cells"][2]["outputs"] = panic;
    assert!(notebook::failure(&executed).expect("a panic").contains("assert!(1 + 1 == 2);"));
    for form in ["Chart { x", "Recording { x"] {
        executed["cells"][2]["outputs"] = json!([{ "output_type": "execute_result", "data": { "text/plain": form } }]);
        assert!(notebook::failure(&executed).expect("not drawn").contains("as text instead of a picture"));
    }
    std::fs::remove_dir_all(&folder).expect("removed");
}
