// Starts `stlc lsp` for the specifications of a workspace, and again when it is asked to.
"use strict";

const vscode = require("vscode");
const { LanguageClient, TransportKind } = require("vscode-languageclient/node");

let client;

/** The command as configured, with the workspace's folder in place of ${workspaceFolder}. */
function command() {
  const folder = vscode.workspace.workspaceFolders?.[0]?.uri.fsPath ?? "";
  const words = vscode.workspace.getConfiguration("stlc").get("command", ["stlc", "lsp"]);
  return words.map((word) => word.replaceAll("${workspaceFolder}", folder));
}

async function start() {
  const [program, ...args] = command();
  const cwd = vscode.workspace.workspaceFolders?.[0]?.uri.fsPath;
  const server = { command: program, args, options: { cwd }, transport: TransportKind.stdio };
  client = new LanguageClient("stlc", "stlc", server, {
    documentSelector: [{ language: "stlc" }],
    synchronize: { fileEvents: vscode.workspace.createFileSystemWatcher("**/*.{yaml,yml,stl,stlc}") },
  });
  try {
    await client.start();
  } catch (error) {
    const advice = "Install stlc with its extra lsp, or say where it is in the setting stlc.command";
    vscode.window.showErrorMessage(`stlc: ${program} does not start (${error.message}). ${advice}`);
  }
}

async function stop() {
  if (client?.isRunning()) {
    await client.stop();
  }
  client = undefined;
}

async function activate(context) {
  const restart = async () => {
    await stop();
    await start();
  };
  context.subscriptions.push(vscode.commands.registerCommand("stlc.restart", restart));
  context.subscriptions.push(
    vscode.workspace.onDidChangeConfiguration((event) => {
      if (event.affectsConfiguration("stlc.command")) {
        restart();
      }
    }),
  );
  await start();
}

module.exports = { activate, deactivate: stop };
