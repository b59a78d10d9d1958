//! The press: `cargo book build`, `serve`, `notebooks`, `check`, `format`, `census`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, SystemTime};
use std::{env, fs};

use anyhow::{Context, Result, bail};
use clap::Parser;
use handful_book::chapter::Chapter;
use handful_book::page::Page;
use handful_book::{census, format, links, notebook};
use mdbook_driver::MDBook;
use mdbook_preprocessor::book::{Book, BookItem};
use mdbook_preprocessor::{Preprocessor, PreprocessorContext};
use serde_json::Value;

/// One source, three outputs: the chapters as pages, notebooks and tests.
#[derive(Parser)]
enum Press {
    /// Build the pages: target/book/index.html
    Build,
    /// Build and serve the pages, and rebuild them when a chapter changes
    Serve {
        /// Address to listen on
        #[arg(long, default_value = "127.0.0.1:3000")]
        address: String,
    },
    /// Generate the notebooks that are out of date and execute them with Jupyter
    Notebooks {
        /// Only these (such as 01-hand), even if they are up to date
        names: Vec<String>,
    },
    /// List the notebooks that are out of date
    Check,
    /// Format the cells of all chapters
    Format,
    /// Run all tests under other seeds, and write into the book how many of them hold (hours)
    Census {
        /// Number of other seeds
        #[arg(long, default_value_t = 20)]
        shakes: u16,
        /// Only programs and tests whose name contains one of these (such as chapter_05); the other rows stay
        names: Vec<String>,
    },
}

fn main() -> Result<()> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").canonicalize()?;
    match Press::parse() {
        Press::Build => build(&root),
        Press::Serve { address } => serve(&root, &address),
        Press::Notebooks { names } => notebooks(&root, &names),
        Press::Check => check(&root),
        Press::Format => format(&root),
        Press::Census { shakes, names } => census::take(&root, shakes, &names),
    }
}

// Pages.

/// The font of the formulas, relative to `book/` and to the pages.
const FONT: &str = "fonts/stix-two-math.woff2";

/// Replaces each chapter by its page, with outputs, formulas and pictures.
struct Splice {
    pages: BTreeMap<String, String>,
}

impl Preprocessor for Splice {
    fn name(&self) -> &'static str {
        "splice"
    }

    fn run(&self, _context: &PreprocessorContext, mut book: Book) -> Result<Book> {
        book.for_each_mut(|item| {
            if let BookItem::Chapter(chapter) = item
                && let Some(path) = &chapter.path
                && let Some(page) = self.pages.get(&path.with_extension("").display().to_string())
            {
                chapter.content.clone_from(page);
            }
        });
        Ok(book)
    }
}

fn build(root: &Path) -> Result<()> {
    let mut pages = BTreeMap::new();
    let mut pictures = Vec::new();
    for chapter in Chapter::all(&root.join("chapters"))? {
        let answers = notebook::read(&root.join(format!("notebooks/{}.ipynb", chapter.name)));
        let answers = answers.map(|notebook| notebook::answers(&notebook)).unwrap_or_default();
        let page = Page::new(&chapter, &answers).with_context(|| format!("chapters/{}.md", chapter.name))?;
        pages.insert(chapter.name.clone(), page.content);
        pictures.extend(page.pictures);
    }
    let mut book = MDBook::load(root.join("book"))?;
    book.with_preprocessor(Splice { pages });
    book.build()?;
    let out = root.join("target/book");
    for picture in pictures {
        let to = out.join(&picture);
        fs::create_dir_all(to.parent().context("a folder")?)?;
        fs::copy(root.join(&picture), &to).with_context(|| format!("{}: needed by a chapter", picture.display()))?;
    }
    fs::copy(root.join("book").join(FONT), out.join(FONT)).context(FONT)?;
    let broken = links::broken(&out)?;
    if !broken.is_empty() {
        bail!("{} broken links:\n{}", broken.len(), broken.join("\n"));
    }
    println!("book: {}", out.join("index.html").display());
    Ok(())
}

fn serve(root: &Path, address: &str) -> Result<()> {
    build(root)?;
    let server = tiny_http::Server::http(address)
        .map_err(|error| anyhow::anyhow!("{address}: {error}; choose another --address"))?;
    println!("reading at http://{address} (Ctrl-C ends)");
    let mut made = SystemTime::now();
    loop {
        if newest(root)? > made {
            made = SystemTime::now();
            if let Err(error) = build(root) {
                eprintln!("{error:#}");
            }
        }
        if let Some(request) = server.recv_timeout(Duration::from_millis(500))? {
            let path = request.url().split(['?', '#']).next().unwrap_or_default();
            let path = path.trim_start_matches('/');
            let path = if path.is_empty() { "index.html" } else { path };
            let file = root.join("target/book").join(path);
            let inside = !path.split('/').any(|part| part == "..");
            match fs::read(&file) {
                Ok(bytes) if inside => {
                    let kind = match file.extension().and_then(|kind| kind.to_str()) {
                        Some("html") => "text/html; charset=utf-8",
                        Some("css") => "text/css",
                        Some("js") => "text/javascript",
                        Some("svg") => "image/svg+xml",
                        Some("woff2") => "font/woff2",
                        Some("png") => "image/png",
                        _ => "application/octet-stream",
                    };
                    let header = tiny_http::Header::from_bytes("Content-Type", kind).expect("a header");
                    let _ = request.respond(tiny_http::Response::from_data(bytes).with_header(header));
                }
                _ => {
                    let _ = request.respond(tiny_http::Response::from_string("not found").with_status_code(404));
                }
            }
        }
    }
}

/// When a chapter, a notebook or a file of `book/` was last written.
fn newest(root: &Path) -> Result<SystemTime> {
    let mut newest = SystemTime::UNIX_EPOCH;
    for folder in ["chapters", "chapters/notes", "notebooks", "book"] {
        for entry in fs::read_dir(root.join(folder))? {
            // An editor's temporary file may be gone again.
            let written = entry?.metadata().and_then(|there| there.modified());
            newest = newest.max(written.unwrap_or(SystemTime::UNIX_EPOCH));
        }
    }
    Ok(newest)
}

fn format(root: &Path) -> Result<()> {
    for chapter in Chapter::all(&root.join("chapters"))? {
        let path = root.join(format!("chapters/{}.md", chapter.name));
        let text = fs::read_to_string(&path)?;
        let formatted = format::rewritten(&chapter.name, &text).with_context(|| path.display().to_string())?;
        if formatted != text {
            fs::write(&path, formatted)?;
            println!("formatted chapters/{}.md", chapter.name);
        }
    }
    Ok(())
}

// Notebooks.

fn check(root: &Path) -> Result<()> {
    let chapters = Chapter::all(&root.join("chapters"))?;
    let complaints: Vec<String> =
        chapters.iter().filter_map(|chapter| notebook::complaint(chapter, &root.join("notebooks"))).collect();
    if complaints.is_empty() {
        println!("all {} notebooks are up to date", chapters.len());
        return Ok(());
    }
    bail!("{}", complaints.join("\n"))
}

fn notebooks(root: &Path, names: &[String]) -> Result<()> {
    let folder = root.join("notebooks");
    let chapters = Chapter::all(&root.join("chapters"))?;
    if let Some(unknown) = names.iter().find(|name| chapters.iter().all(|chapter| chapter.name != **name)) {
        let known: Vec<&str> = chapters.iter().map(|chapter| chapter.name.as_str()).collect();
        bail!("there is no chapter `{unknown}`; there are {}", known.join(", "));
    }
    // Two processes would write the same files. Where the file system has no locks, they cannot be detected.
    let lock = fs::File::open(folder.join("setup")).context("notebooks/setup")?;
    if matches!(lock.try_lock(), Err(fs::TryLockError::WouldBlock)) {
        bail!("another `cargo book notebooks` is running: wait for it, or stop it");
    }
    for chapter in chapters {
        let wanted = if names.is_empty() {
            notebook::complaint(&chapter, &folder).is_some()
        } else {
            names.contains(&chapter.name)
        };
        if wanted
            && names.is_empty()
            && let Some(notebook) = notebook::with_new_text(&chapter, &folder)
        {
            notebook::write(&folder.join(format!("{}.ipynb", chapter.name)), &notebook)?;
            println!("{}: only the text has changed", chapter.name);
        } else if wanted {
            execute(&folder, &chapter).with_context(|| format!("notebooks/{}.ipynb", chapter.name))?;
        }
    }
    Ok(())
}

/// Executes a notebook with Jupyter, and keeps it if no cell failed.
fn execute(folder: &Path, chapter: &Chapter) -> Result<()> {
    let generated = notebook::generate(chapter);
    let mut running = generated.clone();
    // By default the kernel reports a panic as success.
    let setup = format!("{}:preserve_vars_on_panic 0\n", notebook::SETUP);
    running["cells"][0]["source"] = Value::from(setup);
    let path = folder.join(format!(".{}.running.ipynb", chapter.name));
    notebook::write(&path, &running)?;
    let own = folder.join(".venv/bin/jupyter");
    let jupyter = if own.exists() { own } else { PathBuf::from("jupyter") };
    let status = Command::new(&jupyter)
        .args([
            "execute",
            "--inplace",
            "--kernel_name=rust",
            "--timeout=900",
            "--startup_timeout=120",
            "--allow-errors",
        ])
        .arg(&path)
        .current_dir(folder)
        .status();
    let executed = match status {
        Ok(status) if status.success() => notebook::read(&path),
        Ok(status) => bail!("jupyter ended with {status}"),
        Err(error) => bail!("{} could not be started ({error}): run notebooks/setup first", jupyter.display()),
    }?;
    if let Some(failure) = notebook::failure(&executed) {
        bail!("{failure}");
    }
    fs::remove_file(&path)?;
    notebook::write(&folder.join(format!("{}.ipynb", chapter.name)), &notebook::with_answers(generated, &executed))?;
    println!("{}: {}", chapter.name, times(&executed));
    Ok(())
}

/// How long the cells took, without the first, which builds the library.
fn times(executed: &Value) -> String {
    let cells = executed["cells"].as_array().into_iter().flatten().filter(|cell| cell["cell_type"] == "code");
    let mut seconds: Vec<f64> = cells
        .filter_map(|cell| {
            let at = |event: &str| seconds_of_day(cell["metadata"]["execution"][event].as_str()?);
            let (from, to) = (at("iopub.execute_input")?, at("shell.execute_reply")?);
            Some((to - from).rem_euclid(86_400.0))
        })
        .collect();
    if seconds.len() < 2 {
        return "no times recorded".into();
    }
    let first = seconds.remove(0);
    let total: f64 = seconds.iter().sum();
    seconds.sort_by(f64::total_cmp);
    let (median, most) = (seconds[seconds.len() / 2], seconds[seconds.len() - 1]);
    format!("setup {first:.0} s; {} cells in {total:.0} s, median {median:.1} s, longest {most:.1} s", seconds.len())
}

/// The seconds since midnight of `2026-01-02T03:04:05.6Z`.
fn seconds_of_day(time: &str) -> Option<f64> {
    let clock = time.split('T').nth(1)?.trim_end_matches('Z').split('+').next()?;
    let mut parts = clock.split(':').map(|part| part.parse::<f64>().ok());
    Some(parts.next()?? * 3600.0 + parts.next()?? * 60.0 + parts.next()??)
}
